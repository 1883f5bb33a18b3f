"""Tables of numbers as CSV: coefficients of each field position."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from app.files import atomic_write
from app.results.mode_coefficients import mode_names
from reconstruction.arrays import Floats
from reconstruction.field_coefficients import FieldCoefficients
from reconstruction.geometry import Field


def write_table(path: Path, names: Sequence[str], rows: Iterable[Sequence[float]]) -> None:
    """Write rows of numbers as CSV, with all digits; `names` have the units."""
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="ascii") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows(rows)


def table_names(found: FieldCoefficients) -> list[str]:
    """Return the columns of a table: field position, coefficients and standard deviations, with their units."""
    modes = [name.split(" ", 1)[0] for name in mode_names(found.basis, len(found.rad))[1:]]
    return ["x_m", "y_m", *(f"{mode}_rad" for mode in modes), *(f"{mode}_sigma_rad" for mode in modes)]


def table_rows(found: FieldCoefficients, field: Field, x_m: Floats, y_m: Floats) -> Iterator[list[float]]:
    """Yield a row for every position inside the field of the grid x_m (x,), y_m (y,)."""
    x, y = (grid.ravel() / field.half_width_m for grid in np.meshgrid(x_m, y_m))
    inside = field.contains(x, y)
    x, y = x[inside], y[inside]
    place_m = np.stack([x, y]) * field.half_width_m
    yield from np.concatenate([place_m, found.at(x, y)[1:], found.sigma(x, y)[1:]]).T.tolist()

"""Results of single cases, collected into one xarray.Dataset per study."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

Position = float | str  # a number on an axis, or a name
REPEAT = "repeat"  # the dimension of results with the same position: seeds, draws of noise, calls


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseResult:
    """Everything measured of one case."""

    at: Mapping[str, Position]  # position along each dimension of the study
    values: Mapping[str, float | xr.DataArray]  # by quantity; NaN or absent without a result
    name: str = ""  # distinguishes repeats
    problem: str = ""  # the reason for a missing result


def collect(dims: Sequence[str], results: Iterable[CaseResult]) -> xr.Dataset:
    """Arrange results along the dimensions of their study and `repeat`.

    Parameters
    ----------
    dims
        Names of the dimensions; their coordinates keep the order in which they occur.
    results
        Results of any number of repeats per position.

    Returns
    -------
    xarray.Dataset
        A variable (*dims, repeat, ...) per quantity, NaN where nothing was measured, and the text variables `name`
        and `problem`.
    """
    results = tuple(results)
    axes = {dim: list(dict.fromkeys(result.at[dim] for result in results)) for dim in dims}
    cells: dict[tuple[int, ...], list[CaseResult]] = {}
    for result in results:
        cells.setdefault(tuple(axes[dim].index(result.at[dim]) for dim in dims), []).append(result)
    shape = (*map(len, axes.values()), max(map(len, cells.values()), default=0))
    cell_dims, coords = (*dims, REPEAT), dict[str, Any](axes)
    variables: dict[str, tuple[tuple[str, ...], NDArray[Any]]] = {
        text: (cell_dims, np.full(shape, "", object)) for text in ("name", "problem")
    }
    for place, repeats in cells.items():
        for repeat, result in enumerate(repeats):
            variables["name"][1][*place, repeat] = result.name
            variables["problem"][1][*place, repeat] = result.problem
            for quantity, value in result.values.items():
                if quantity not in variables:
                    value_dims = map(str, value.dims) if isinstance(value, xr.DataArray) else ()
                    variables[quantity] = ((*cell_dims, *value_dims), np.full(shape + np.shape(value), np.nan))
                    if isinstance(value, xr.DataArray):
                        coords |= {str(dim): value[dim] for dim in value.coords}
                variables[quantity][1][*place, repeat] = value
    return xr.Dataset(variables, coords=coords)


def rows(data: xr.Dataset, dims: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield position and known numbers of every case with at least one; all variables of numbers are over `dims`."""
    axes = [data[dim].values.tolist() for dim in dims]
    numbers = {str(name): variable for name, variable in data.data_vars.items() if variable.dtype != object}
    columns = {name: variable.transpose(*dims).values for name, variable in numbers.items()}
    for place in np.ndindex(*map(len, axes)):
        known = {name: values[place].item() for name, values in columns.items() if np.isfinite(values[place])}
        if known:
            yield {dim: axis[index] for dim, axis, index in zip(dims, axes, place, strict=True)} | known

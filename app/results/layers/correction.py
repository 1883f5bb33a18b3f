"""`svwfs corrector`: what one corrector could do, over its distance, and its best command."""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray

from app.bench.config import Bench
from app.errors import InputError
from app.files import atomic_write, check_outputs
from app.progress import Progress, between
from app.recording.folder import parts_of
from app.results.dataset import write_results
from app.results.field_wavefront import mean_wavefront, read_bench_of
from app.results.layers.dataset import Origin, distance_m, ratio_at
from app.results.plot import check_plot_path
from app.results.view_quality import about
from reconstruction.arrays import Floats
from reconstruction.layers.corrector import Correction, Corrector, best_correction

_POSITIONS = 7  # along each side of the field
_SHARES = np.linspace(0.0, 0.95, 39)  # ratio / (1 + ratio) of the correctors compared
_REFINED = 0.02  # about the best of them
_FORMATS = (".npy", ".fits", ".png")
_GREY = 256  # levels of a wrapped phase
_FITS_BLOCK = 2880  # bytes


def compare_correctors(  # noqa: PLR0913 - the options of the command
    source: Path,
    *,
    corrector: Corrector,
    at_m: float | None,
    origin: Origin,
    frames: str | None,
    out: Path,
    plot: Path | None,
    command: Path | None,
    pixels: int,
    overwrite: bool,
    progress: Progress,
) -> xr.Dataset:
    """Compare correctors at every distance, and write the best one's command, or that of the one at `at_m`."""
    check_outputs([out, plot, command], inputs=parts_of(source) if source.is_dir() else [source], overwrite=overwrite)
    if plot is not None:
        check_plot_path(plot)
    if command is not None and command.suffix.lower() not in _FORMATS:
        raise InputError(f"{command}: give a name that ends in one of {', '.join(_FORMATS)}")
    bench = read_bench_of(source)
    chosen = None if at_m is None else ratio_at(at_m, origin, bench)
    phase_at = mean_wavefront(source, bench, frames, between(progress, 0, 0.7))
    positions_m = field_positions_m(bench)
    wavefronts = np.array([phase_at(x_m, y_m) for x_m, y_m in positions_m])

    def correct(ratio: float) -> Correction:
        try:
            return best_correction(wavefronts, positions_m, bench.sensor, bench.field, ratio, corrector)
        except ValueError as error:
            raise InputError(f"{source}: {error}") from error

    curve = [correct(float(share / (1 - share))) for share in _SHARES]
    progress("comparing correctors", 0.8)
    if chosen is None:
        best = _SHARES[int(np.argmin([made.mean_residual_rad for made in curve]))]
        near = np.clip(best + np.linspace(-_REFINED, _REFINED, 21), 0, _SHARES[-1])
        made = min((correct(float(share / (1 - share))) for share in near), key=lambda made: made.mean_residual_rad)
    else:
        made = correct(chosen)
    found = correction_dataset(curve, made, positions_m, bench, origin)
    write_results(out, found, bench=bench, inputs={"source": source.name})
    if command is not None:
        write_command(command, command_map(made, pixels))
    if plot is not None:
        with atomic_write(plot) as temporary:
            correction_figure(found).savefig(temporary, dpi=150)
    progress("comparing correctors", 1.0)
    return found


def field_positions_m(bench: Bench) -> Floats:
    """Field positions, evenly spread over the field, at which correctors are judged, (position, xy)."""
    along = np.linspace(-1, 1, _POSITIONS)
    y, x = (grid.ravel() for grid in np.meshgrid(along, along, indexing="ij"))
    inside = bench.field.contains(x, y)
    return np.stack([x, y], axis=-1)[inside] * bench.field.half_width_m


def correction_dataset(
    curve: list[Correction], made: Correction, positions_m: Floats, bench: Bench, origin: Origin
) -> xr.Dataset:
    """Return residual and Strehl ratio over the distance, and those of one corrector over the field."""
    distances_m = distance_m(np.array([each.ratio for each in curve]), origin, bench)
    order = np.argsort(distances_m)
    residual, strehl = (
        np.array(values)[order]
        for values in ([each.mean_residual_rad for each in curve], [each.strehl.mean() for each in curve])
    )
    from_where = f"distance of the corrector from the {origin}"
    return xr.Dataset(
        {
            "residual": ("distance", residual, about("rad", "RMS over field and pupil after the best command")),
            "strehl": ("distance", strehl, about("1", "mean over the field")),
            "corrector_distance_m": ((), distance_m(made.ratio, origin, bench), about("m", from_where)),
            "corrector_residual": ((), made.mean_residual_rad, about("rad", "RMS over field and pupil")),
            "field_residual": ("position", made.residual_rad, about("rad", "RMS at a field position")),
            "field_strehl": ("position", made.strehl, about("1", "at a field position")),
            "command": ("shape", made.command, about("rad", "best command: the corrector adds these shapes")),
        },
        coords={
            "distance": ("distance", distances_m[order], about("m", from_where)),
            "field_x": ("position", positions_m[:, 0], about("m", "field position")),
            "field_y": ("position", positions_m[:, 1], about("m", "field position")),
        },
        attrs={
            "title": "Best commands of a corrector",
            "distances_from": origin,
            "influence": made.corrector.influence,
            "shapes": made.corrector.count,
        },
    )


def command_map(made: Correction, pixels: int) -> Floats:
    """Phase that the corrector adds, (row, column), rad, `pixels` along its longer side; without piston."""
    half_x_m, half_y_m = made.half_width_m
    longer_m = max(half_x_m, half_y_m)
    x_m, y_m = (
        np.linspace(-half_m, half_m, max(2, round(pixels * half_m / longer_m))) for half_m in (half_x_m, half_y_m)
    )
    phase = made.phase(x_m, y_m[:, None])
    return np.asarray(phase - phase.mean())


def write_command(path: Path, phase_rad: Floats) -> None:
    """Write a phase map: NPY or FITS in rad, or an 8-bit PNG wrapped at 2 pi, 256 levels to a wave."""
    suffix = path.suffix.lower()
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        if suffix == ".npy":
            np.save(file, phase_rad.astype(np.float32))
        elif suffix == ".fits":
            file.write(_fits(phase_rad))
        else:
            file.write(cv2.imencode(".png", wrapped(phase_rad))[1].tobytes())


def wrapped(phase_rad: Floats) -> NDArray[np.uint8]:
    """Grey levels of a phase for a modulator: 0 ... 255 for 0 ... 2 pi."""
    return np.asarray(np.rint(np.mod(phase_rad, 2 * math.pi) / (2 * math.pi) * _GREY) % _GREY, np.uint8)


def _fits(phase_rad: Floats) -> bytes:
    """Primary HDU of 32-bit floats (FITS 4.0, sections 4 and 5)."""
    rows, columns = phase_rad.shape
    cards: dict[str, Any] = {"SIMPLE": "T", "BITPIX": -32, "NAXIS": 2, "NAXIS1": columns, "NAXIS2": rows}
    lines = [f"{name:8}= {value:>20}" for name, value in cards.items()] + ["BUNIT   = 'rad     '", "END"]
    header = "".join(f"{line:80}" for line in lines).encode("ascii")
    pixels = phase_rad.astype(">f4").tobytes()
    return header.ljust(-(-len(header) // _FITS_BLOCK) * _FITS_BLOCK) + pixels.ljust(
        -(-len(pixels) // _FITS_BLOCK) * _FITS_BLOCK, b"\0"
    )


def correction_figure(found: xr.Dataset) -> Figure:
    """Return the figure: residual over the distance, and over the field."""
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    left.plot(found["distance"] * 1e3, found["residual"], color="#35739f", marker=".")
    at_mm, residual = float(found["corrector_distance_m"]) * 1e3, float(found["corrector_residual"])
    left.plot([at_mm], [residual], "o", color="#d1495b", label=f"{at_mm:.0f} mm: {residual:.2g} rad")
    left.set(
        xlim=(0, max(300, 2 * at_mm)),
        ylim=(0, None),
        xlabel=f"distance of the corrector from the {found.attrs['distances_from']} (mm)",
        ylabel="residual over the field (rad RMS)",
        title=f"Best command of {found.attrs['shapes']} {found.attrs['influence']} shapes",
    )
    left.legend()
    shown = right.scatter(
        found["field_x"] * 1e3, found["field_y"] * 1e3, c=found["field_residual"], s=160, marker="s", vmin=0
    )
    right.set(xlabel="field x (mm)", ylabel="field y (mm)", aspect="equal", title="Residual (rad RMS)")
    right.invert_yaxis()  # +y down, as on the camera
    figure.colorbar(shown, ax=right)
    return figure


def summary(found: xr.Dataset) -> list[str]:
    """Residuals in sentences."""
    origin = found.attrs["distances_from"]
    at_pupil = found["residual"].values[0 if origin == "lenslets" else -1]
    best = f"{float(found['corrector_residual']):.3g} rad, Strehl ratio {float(found['field_strehl'].mean()):.2f}"
    return [
        f"a corrector at the pupil leaves {at_pupil:.3g} rad RMS over the field",
        f"one at {float(found['corrector_distance_m']) * 1e3:.1f} mm from the {origin} leaves {best}",
    ]

"""Residual that one corrector leaves at every distance (docs/layers.md), and its best command."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench, as_bench
from app.errors import InputError
from app.files import atomic_write
from app.results import layers
from app.results.result_file import about
from app.results.sources import phase_of
from reconstruction.arrays import Floats
from reconstruction.layers.corrector import Correction, Corrector, Influence, best_correction, field_positions_m
from reconstruction.runtime.opencv import cv2
from reconstruction.wavefront import Wavefront, rms

if TYPE_CHECKING:
    import xarray as xr

    from app.plotting import Figure

PHASE_FORMATS = (".npy", ".fits", ".png")
DEFAULT = Corrector("zernike", 45)
_SHARES = np.linspace(-0.95, 0.95, 77)  # ratio / (1 + |ratio|) of the correctors compared
_GREY = 256  # levels of a wrapped phase
_REFINED = 0.02  # about the best of them


def find_corrector(
    source: Wavefront | str | Path,
    bench: Bench,
    *,
    modes: Influence = DEFAULT.influence,
    count: int = DEFAULT.count,
    distance_m: float | None = None,
) -> xr.Dataset:
    """Find what a corrector at each conjugate distance leaves, and its best command (docs/layers.md).

    Parameters
    ----------
    source
        A wavefront, a file of results, or the folder of a recording, whose frames are averaged.
    modes
        Shapes that the corrector can take over its footprint.
    count
        Number of modes, the piston included, or of actuators, which is a square.
    distance_m
        Distance of the corrector in front of the lenslets, negative behind them; the best one if omitted.

    Returns
    -------
    xarray.Dataset
        `residual(distance)` in rad and `strehl(distance)` over the distance from the lenslets, `uncorrected` in rad; of
        one corrector `corrector_distance_m`, `corrector_residual`, `command(shape)` and `command_phase(y, x)` in rad.

    Raises
    ------
    InputError
        If source, modes or distance cannot be used; the message says why.

    Examples
    --------
    >>> found = svwfs.find_corrector(wavefront, bench)
    >>> bool(abs(found["corrector_distance_m"] - 0.195) < 0.01)  # that of the screen
    True
    >>> bool(found["corrector_residual"] < 0.1 * found["residual"].sel(distance=0))
    True
    """
    bench = as_bench(bench)
    phase_at = phase_of(source, bench)
    try:
        return compare_correctors(phase_at, bench, Corrector(modes, count), at_m=distance_m, origin="lenslets")[0]
    except ValueError as error:
        raise InputError(str(error)) from error


def compare_correctors(
    phase_at: Callable[[float, float], Floats],
    bench: Bench,
    corrector: Corrector,
    *,
    at_m: float | None,
    origin: layers.Origin,
) -> tuple[xr.Dataset, Correction]:
    """Find the best commands of correctors at every distance; choose the best one, or that at `at_m`.

    `phase_at` returns the wavefront at a field position (x_m, y_m), rad, (lenslet_row, lenslet_column); `ValueError` if
    no lenslet is known. Returns residual and Strehl ratio over the distance, those of the chosen corrector over the
    field, and this corrector. Distances are from the lenslets if it lies behind them, see `possible_origin`.
    """
    import xarray as xr

    ratio = None if at_m is None else layers.ratio_at(at_m, origin, bench)
    positions_m = field_positions_m(bench.field)
    wavefronts = np.array([phase_at(x_m, y_m) for x_m, y_m in positions_m])
    if np.array_equal(wavefronts, np.broadcast_to(wavefronts[0], wavefronts.shape), equal_nan=True):
        raise ValueError("the wavefront is the same at every field position: correctors at all distances are alike")

    def made_at(ratio: float) -> Correction:
        return best_correction(
            wavefronts,
            positions_m=positions_m,
            sensor=bench.sensor,
            field=bench.field,
            ratio=ratio,
            corrector=corrector,
        )

    curve, made = _corrections(made_at, ratio)
    uncorrected_rad = float(np.sqrt(np.nanmean(rms(wavefronts) ** 2)))
    origin = layers.possible_origin(origin, [made.ratio])
    distances_m, order = layers.tried_distances_m(np.array([each.ratio for each in curve]), origin, bench)
    residual, strehl = np.array([(each.mean_residual_rad, np.nanmean(each.strehl)) for each in curve])[order].T
    of_distance = f"of the corrector; {layers.from_where(origin)}"
    x_m, y_m, phase = made.phase_map(layers.MAP_POINTS)
    found = xr.Dataset(
        {
            "uncorrected": ((), uncorrected_rad, about("rad", "RMS over field and pupil without a corrector")),
            "residual": ("distance", residual, about("rad", "RMS over field and pupil after the best command")),
            "strehl": ("distance", strehl, about("1", "mean over the field")),
            "corrector_distance_m": ((), layers.distance_m(made.ratio, origin, bench), about("m", of_distance)),
            "corrector_residual": ((), made.mean_residual_rad, about("rad", "RMS over field and pupil")),
            "field_residual": ("position", made.residual_rad, about("rad", "RMS at a field position")),
            "field_strehl": ("position", made.strehl, about("1", "at a field position")),
            "command": ("shape", made.command, about("rad", "best command: the corrector adds these shapes")),
            "command_phase": (("y", "x"), phase, about("rad", "phase that the corrector adds, without piston")),
        },
        coords={
            "distance": ("distance", distances_m, about("m", of_distance)),
            "field_x": ("position", positions_m[:, 0], about("m", "field position")),
            "field_y": ("position", positions_m[:, 1], about("m", "field position")),
            "x": ("x", x_m, about("m", "on the plane s = u + r x")),
            "y": ("y", y_m, about("m", "on the plane s = u + r x")),
        },
        attrs={
            "title": "Best commands of a corrector",
            "distances_from": origin,
            "influence": made.corrector.influence,
            "shapes": made.corrector.count,
        },
    )
    return found, made


def corrector_sentence(found: xr.Dataset) -> str:
    """Say what correctors leave at the pupil and at the chosen distance, and what is there without one."""
    origin, residual = found.attrs["distances_from"], found["residual"].values
    at_pupil = residual[np.argmin(np.abs(found["distance"].values)) if origin == "lenslets" else -1]
    place = layers.distance_in_words(float(found["corrector_distance_m"]), np.nan, origin)
    pupil = f"one corrector at the pupil leaves {at_pupil:.2g} of {float(found['uncorrected']):.2g} rad RMS"
    strehl = f"Strehl {float(found['field_strehl'].mean()):.2f}"
    return f"{pupil}; {place}, {float(found['corrector_residual']):.2g} rad ({strehl})"


def draw_corrector(found: xr.Dataset) -> Figure:
    """Draw the residual over the distance, and over the field."""
    from app.plotting import Figure

    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    left.plot(found["distance"] * 1e3, found["residual"], color="#35739f", marker=".")
    origin, at_m = found.attrs["distances_from"], float(found["corrector_distance_m"])
    residual = float(found["corrector_residual"])
    label = f"{layers.distance_in_words(at_m, np.nan, origin)}: {residual:.2g} rad"
    left.plot([at_m * 1e3], [residual], "o", color="#d1495b", label=label)
    uncorrected = float(found["uncorrected"])
    label = f"uncorrected: {uncorrected:.2g} rad"
    left.axhline(uncorrected, color="0.5", linewidth=0.8, linestyle="--", label=label)
    title = f"Best command of {found.attrs['shapes']} {found.attrs['influence']} shapes"
    left.set(ylabel="residual over the field (rad RMS)", title=title)
    layers.set_distance_axes(left, found, found["corrector_distance_m"].values)
    left.legend()
    x_mm, y_mm = (found[name] * 1e3 for name in ("field_x", "field_y"))
    shown = right.scatter(x_mm, y_mm, c=found["field_residual"], s=160, marker="s", vmin=0)
    right.set(xlabel="field x (mm)", ylabel="field y (mm)", aspect="equal", title="Residual (rad RMS)")
    right.invert_yaxis()  # +y down, as on the camera
    figure.colorbar(shown, ax=right)
    return figure


def _corrections(made_at: Callable[[float], Correction], ratio: float | None) -> tuple[list[Correction], Correction]:
    """Corrections in the order of their ratios, and the best of them, or that at the given `ratio`."""

    def at_share(share: float) -> Correction:
        return made_at(float(share / (1 - abs(share))))

    curve = [at_share(share) for share in _SHARES]
    if ratio is None:
        best = _SHARES[int(np.argmin([made.mean_residual_rad for made in curve]))]
        curve += [at_share(share) for share in best + np.linspace(-_REFINED, _REFINED, 21) if abs(share) < _SHARES[-1]]
        chosen = min(curve, key=lambda made: made.mean_residual_rad)
    else:
        chosen = made_at(ratio)
        curve.append(chosen)
    return list({made.ratio: made for made in sorted(curve, key=lambda made: made.ratio)}.values()), chosen


def write_phase(path: Path, phase_rad: Floats) -> None:
    """Write a phase map (row, column): NPY or FITS in rad, or an 8-bit PNG wrapped at 2 pi."""
    suffix = path.suffix.lower()
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        if suffix == ".npy":
            np.save(file, phase_rad.astype(np.float32))
        elif suffix == ".fits":
            from astropy.io import fits

            fits.PrimaryHDU(phase_rad.astype(np.float32), fits.Header({"BUNIT": "rad"})).writeto(file)
        else:
            file.write(cv2.imencode(".png", wrapped(phase_rad))[1].tobytes())


def wrapped(phase_rad: Floats) -> NDArray[np.uint8]:
    """Grey levels of a phase (row, column) for a modulator: 0 ... 255 for 0 ... 2 pi."""
    return np.asarray(np.rint(np.mod(phase_rad, 2 * math.pi) / (2 * math.pi) * _GREY) % _GREY, np.uint8)

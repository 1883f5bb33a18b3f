"""Finding the lattice of lenslets in a reference.

Every lenslet images the same thing, so the light of each cell repeats that of its neighbours. The spectrum of the frame
says roughly with which pitch and rotation; the phases of the first harmonic of the cells' light, and then the cells
themselves compared with the typical one, say it to a small part of a pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage

from reconstruction.arrays import Counts, Floats, Image, Mask
from reconstruction.errors import ReconstructionError
from reconstruction.frame.bad_pixels import find_bad_pixels, repaired
from reconstruction.geometry import Lattice, Sensor
from reconstruction.lattice.fit import SMALLEST_PITCH_PX, Fit, fit_lattice
from reconstruction.lattice.rejection import is_outstanding, why_no_lattice
from reconstruction.lattice.spectrum import REACH, Peak, strongest_peak, without_peaks

_SATURATED_FRACTION = 0.01  # of the pixels
_DARK_AT_MOST = 8  # times as many lenslets as are lit may there be
_OCCUPIED = 0.5  # of the usual number of lit lenslets makes a row or a column of the array; the others may be dead
_MANY = 2000  # cells; what is a lattice to `why_no_lattice` stands out of the spectrum by 0.5 sqrt(cells), noise by 3.5
_OTHER_PITCHES = 0.5, 2.0  # of the designed one; that is how focal lengths and binnings are confused
_ALIKE = 0.3  # rows and columns; blocks that differ by less have as many lit lenslets


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Survey:
    """The lattice that a reference shows, and how well."""

    lattice: Lattice  # its middle is that of the sensor's block of lenslets
    rows: int  # of lenslets that are lit and lie whole on the frame, whatever the sensor has
    columns: int
    illuminated: Mask  # which of the sensor's lenslets are lit, (lenslet_row, lenslet_column)
    displacement_px: Floats  # of their light from the lattice, NaN where not lit, (lenslet_row, lenslet_column, xy)
    brightness: Floats  # of each lenslet over the typical one's, (lenslet_row, lenslet_column)
    typical: Floats  # light of a lit lenslet over its cell, mean 0, (sample_row, sample_column)
    likeness: float  # median correlation of a lit lenslet's image with the typical one, 1 when they are all the same

    @property
    def residual_px(self) -> float:
        """RMS distance of the lit lenslets' light from the lattice."""
        return float(np.sqrt(np.nanmean(np.sum(self.displacement_px**2, axis=-1))))

    @property
    def illuminated_fraction(self) -> float:
        """Share of the sensor's lenslets that are lit."""
        return float(np.mean(self.illuminated))


def find_lattice(reference: Counts, sensor: Sensor) -> Lattice:
    """Find where the sensor's lenslets lie on a reference (row, column); raises as `survey` does."""
    return survey(reference, sensor).lattice


def survey(
    reference: Counts,
    sensor: Sensor,
    *,
    dark: Counts | None = None,
    full_scale: float = np.inf,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> Survey:
    """Find the sensor's lenslets on a reference (row, column), counts, and say how well the frame shows them.

    The pitch may differ from the designed one by 15 %. The rotation is the one within +-45 degrees: a square lattice
    looks the same after a quarter turn, so a sensor mounted on its side cannot be told from one that is upright. The
    subimages must be symmetric about the lenslet axes on average; `reconstruction.lattice.fit` says what is taken for
    the centre where they are not. Of the lattice's cells those are taken for the sensor's that have most lit lenslets,
    and of blocks alike the one closest to the frame's middle. Raises `ReconstructionError`, in one sentence, when the
    frame shows no such lattice. `progress` receives the present step and the share that is done, 0 ... 1.
    """
    light, pitch_px = _light(reference, sensor, dark, full_scale), sensor.lenslet_pitch_px
    progress("looking for a lattice", 0.0)
    if not _may_show(light, pitch_px):
        raise ReconstructionError(_refusal(pitch_px, "was the light on?"), image="reference")
    progress("looking for bad pixels", 0.1)
    light = repaired(light, find_bad_pixels(reference, dark))
    progress("fitting the lattice", 0.25)
    fit, why = _fitted(light, sensor, pitch_px)
    for tried, factor in enumerate(_OTHER_PITCHES, 1):
        if fit is None:
            progress(f"fitting one of {pitch_px * factor:.1f} px pitch", (tried + 1) / 4)
            fit, _ = _fitted(light, sensor, pitch_px * factor)
    if fit is not None and abs(fit.lattice.pitch_px / pitch_px - 1) < REACH:
        return _of_the_sensor(fit, sensor, light.shape)
    if fit is not None:
        why = f"it shows one of {fit.lattice.pitch_px:.1f} px; check sensor.lenslet_pitch_m and pixel_pitch_m"
    raise ReconstructionError(_refusal(pitch_px, why), image="reference")


def _refusal(pitch_px: float, why: str) -> str:
    return f"the reference shows no lattice of {pitch_px:.1f} px pitch: {why}"


def _may_show(light: Image, pitch_px: float) -> bool:
    """Whether a frame (row, column), bad pixels and all, may show a lattice of about that pitch, its half or double.

    A look at the spectrum tells, quickly, where a frame has room for many cells; others have to be fitted to know.
    """
    if light.size < _MANY * pitch_px**2:
        return True
    light = without_peaks(light)
    return any(is_outstanding(strongest_peak(light, pitch_px * factor)) for factor in (1.0, *_OTHER_PITCHES))


def _fitted(light: Image, sensor: Sensor, pitch_px: float) -> tuple[Fit | None, str]:
    """Fit a lattice of about that pitch to the light of a frame (row, column); or say why there is none."""
    if pitch_px < SMALLEST_PITCH_PX or min(light.shape) < 2 * pitch_px:
        return None, "its pitch is too small or too large"
    brightest = max(1, sensor.lenslet_rows * sensor.lenslet_columns // _DARK_AT_MOST)
    peak = strongest_peak(light, pitch_px)
    fit = fit_lattice(light, _start(peak, light.shape), brightest)
    why = why_no_lattice(fit, peak, light, brightest)
    return (None if why else fit), why


def _start(peak: Peak, shape: tuple[int, int]) -> Lattice:
    """Return the lattice of the spectrum's peak about the middle of the frame."""
    return Lattice(
        center_x_px=(shape[1] - 1) / 2,
        center_y_px=(shape[0] - 1) / 2,
        pitch_px=max(peak.pitch_px, SMALLEST_PITCH_PX),
        rotation_rad=peak.rotation_rad,
    )


def _light(reference: Counts, sensor: Sensor, dark: Counts | None, full_scale: float) -> Image:
    """Check the reference and return its light above the dark."""
    if reference.ndim != 2 or 0 in reference.shape:
        raise ReconstructionError("the reference is no image of rows x columns", image="reference")
    rows, columns = reference.shape
    smallest_px = sensor.lenslet_pitch_px * (1 - REACH)
    if rows < sensor.lenslet_rows * smallest_px - 2 or columns < sensor.lenslet_columns * smallest_px - 2:
        raise ReconstructionError(
            f"{sensor.lenslet_rows} x {sensor.lenslet_columns} lenslets of {sensor.lenslet_pitch_px:.1f} px do not fit"
            f" on {rows} x {columns} pixels",
            image="reference",
        )
    if dark is not None and np.shape(dark) != reference.shape:
        raise ReconstructionError("the dark has another size than the reference", image="dark")
    for image, name in ((reference, "reference"), (dark, "dark")):
        if image is not None and not np.isfinite(image).all():
            raise ReconstructionError(f"the {name} holds values that are not finite", image=name)
    if np.count_nonzero(reference >= full_scale) > _SATURATED_FRACTION * reference.size:
        raise ReconstructionError(
            "the reference is saturated: shorten the exposure or lower the light's current", image="reference"
        )
    light = np.asarray(reference, np.float32) - np.float32(0 if dark is None else dark)
    if np.ptp(light) == 0:
        raise ReconstructionError("the reference shows no lattice: all its pixels are alike", image="reference")
    return light


def _of_the_sensor(fit: Fit, sensor: Sensor, shape: tuple[int, int]) -> Survey:
    """Choose the sensor's lenslets among the cells of the fit."""
    first = fit.cells.index.min(axis=0)
    columns, rows = fit.cells.index.max(axis=0) - first + 1
    x, y = (fit.cells.index - first).T
    whole = np.zeros((rows, columns), np.bool_)
    lit, brightness, beside = np.zeros_like(whole), np.zeros(whole.shape), np.full((*whole.shape, 2), np.nan)
    whole[y, x], lit[y, x] = True, fit.match.is_lit
    brightness[y, x], beside[y, x] = fit.match.brightness, fit.off_lattice * fit.lattice.pitch_px
    beside[~lit] = np.nan
    extent = _extent(lit)
    wanted = (sensor.lenslet_rows, sensor.lenslet_columns)
    found = [part.stop - part.start for part in extent]
    fits: Mask = np.zeros((0, 0), np.bool_)
    if wanted[0] <= rows and wanted[1] <= columns:
        fits = np.asarray(sliding_window_view(whole, wanted).all(axis=(2, 3)))
    if not fits.any() or any(_is_cut(*line) for line in zip(extent, whole.shape, wanted, strict=True)):
        raise ReconstructionError(
            f"of the lattice of {fit.lattice.pitch_px:.1f} px only {found[0]} x {found[1]} lenslets lie whole on the"
            f" frame, not the sensor's {wanted[0]} x {wanted[1]}: move the camera, or change sensor.lenslet_rows and"
            " lenslet_columns",
            image="reference",
        )
    light = np.add.outer(_occupied(lit, 1, wanted[0]), _occupied(lit, 0, wanted[1]))
    top, left = np.indices(fits.shape)
    middle = np.stack([left + (wanted[1] - 1) / 2, top + (wanted[0] - 1) / 2], axis=-1) + first
    center_px = fit.lattice.to_camera_px(middle * fit.lattice.pitch_px)
    away_px = np.hypot(*np.moveaxis(center_px - (np.array(shape[::-1]) - 1) / 2, -1, 0))
    alike = fits & (light >= light[fits].max() - _ALIKE)
    row, column = np.unravel_index(np.argmin(np.where(alike, away_px, np.inf)), fits.shape)
    block = slice(row, row + wanted[0]), slice(column, column + wanted[1])
    center_x_px, center_y_px = center_px[row, column]
    return Survey(
        lattice=replace(fit.lattice, center_x_px=float(center_x_px), center_y_px=float(center_y_px)),
        rows=found[0],
        columns=found[1],
        illuminated=lit[block],
        displacement_px=beside[block],
        brightness=brightness[block],
        typical=fit.match.typical,
        likeness=float(np.median(fit.match.likeness[fit.match.is_lit])),
    )


def _extent(lit: Mask) -> tuple[slice, slice]:
    """Rows and columns of the largest patch of lit cells that touch one another."""
    patches, count = ndimage.label(lit, np.ones((3, 3)))
    sizes = np.bincount(patches.ravel(), minlength=count + 1)[1:]
    rows, columns = ndimage.find_objects(patches)[int(np.argmax(sizes))]
    return rows, columns


def _is_cut(lit: slice, whole: int, wanted: int) -> bool:
    """Whether lit rows (or columns) end at one edge of the frame, too few, while there is room beside them."""
    return bool(lit.stop - lit.start < wanted < whole and (lit.start == 0) != (lit.stop == whole))


def _occupied(lit: Mask, axis: int, wanted: int) -> Floats:
    """How many of the rows (or columns) are lit in each block of `wanted`; one lit by half counts fully, (block,)."""
    count = lit.sum(axis=axis)
    usual = np.median(np.sort(count)[-wanted:])
    return np.convolve(np.minimum(1, count / max(_OCCUPIED * usual, 1)), np.ones(wanted), "valid")

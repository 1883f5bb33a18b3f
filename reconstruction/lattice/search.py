"""Search for the lenslet lattice in a reference.

The light of each cell repeats that of its neighbours. The spectrum gives rough pitch and rotation; the phases of the
cells' first harmonics, then the comparison of the cells with the typical one, refine them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Booleans, Counts, Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.frame.bad_pixels import find_bad_pixels, repaired
from reconstruction.frame.pixels import require_unsaturated
from reconstruction.geometry import Arrangement, Lattice, Sensor, lenslet_centers, nominal_lattice
from reconstruction.lattice._fit import (
    REACH,
    SMALLEST_PITCH_PX,
    Fit,
    fit_lattice,
    is_outstanding,
    seems_to_be_other,
    strongest_peak,
    why_no_lattice,
    why_not_seen,
    without_peaks,
)

_DARK_AT_MOST = 8  # largest ratio of all lenslets to the lit ones
_FEW = 5  # rows or columns where their number is omitted
_SAME = 0.5  # correlation of a dark with the reference
_OCCUPIED = 0.5  # of the usual number of lit lenslets makes a row or column count fully
_MANY = 2000  # cells, from which on a lattice's spectral peak, 0.5 sqrt(cells), is far above the noise, 3.5
_OTHER: dict[Arrangement, Arrangement] = {"square": "hexagonal", "hexagonal": "square"}
_OTHER_PITCHES = 0.5, 2.0  # over the designed one, from a wrong focal length or binning
# Rows and columns; blocks that differ by less count as equally lit. Columns of hexagonal arrays end in single lenslets.
_ALIKE = {"square": 0.3, "hexagonal": 0.1}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Survey:
    """The lattice that a reference shows, and its quality."""

    sensor: Sensor  # with the numbers of rows and columns
    lattice: Lattice  # centred on the sensor's lenslets
    rows: int  # of lit lenslets, also beyond the sensor's
    columns: int
    illuminated: Booleans  # the sensor's lit lenslets, (lenslet_row, lenslet_column); the others are absent
    displacement_px: Floats  # of their light from the lattice, NaN where not lit, (lenslet_row, lenslet_column, xy)
    typical: Floats  # light of a lit lenslet over its cell, mean 0, (sample_row, sample_column)
    likeness: float  # median correlation of the lit lenslets' images with the typical one, 1 if all are equal

    @property
    def residual_px(self) -> float:
        """RMS distance of the lit lenslets' light from the lattice."""
        return float(np.sqrt(np.nanmean(np.sum(self.displacement_px**2, axis=-1))))


def survey(
    reference: Counts,
    sensor: Sensor,
    *,
    dark: Counts | None = None,
    full_scale: float = np.inf,
    progress: Callable[[str, float], None] = lambda *_: None,
) -> Survey:
    """Find the sensor's lenslets on a reference, and measure how well it shows them.

    The lattice's cells with most lit lenslets are the sensor's; of equal blocks, the one nearest to the frame's middle.
    Cells may be dark or lie off the frame. Rows and columns that the sensor omits are as many as are lit. The subimages
    must be symmetric on average; otherwise see `fit_lattice` for the centre. The pitch may differ by 15 %
    from the sensor's; the rotation is the least, see `least_rotation_rad`.

    Parameters
    ----------
    reference, dark : (row, column)
        Counts with and without light.
    full_scale : float
        Count at which a pixel is saturated.
    progress : callable
        Receives the current step and the fraction done, 0 ... 1.

    Raises
    ------
    ReconstructionError
        If the reference shows no such lattice; the text says why.
    """
    try:
        return _surveyed(reference, sensor, dark, full_scale, progress)
    except ReconstructionError as refusal:
        if dark is not None and refusal.image == "reference" and _are_alike(reference, dark, sensor.lenslet_pitch_px):
            raise ReconstructionError(
                "the dark shows the same light as the reference: was the light off when it was taken?", image="dark"
            ) from refusal
        raise


def _are_alike(reference: Counts, dark: Counts, pitch_px: float) -> bool:
    """True if both images (row, column) have the same structure of the size of a cell."""
    smooth = [ndimage.median_filter(np.asarray(image, np.float32), 3) for image in (reference, dark)]
    first, second = (image - ndimage.uniform_filter(image, round(pitch_px)) for image in smooth)
    return bool(np.vdot(first, second) > _SAME * np.linalg.norm(first) * np.linalg.norm(second))


def _surveyed(
    reference: Counts, sensor: Sensor, dark: Counts | None, full_scale: float, progress: Callable[[str, float], None]
) -> Survey:
    """Survey the lattice, whatever the dark shows; see `survey`."""
    light, pitch_px = _light(reference, sensor, dark, full_scale), sensor.lenslet_pitch_px
    progress("searching for a lattice", 0.0)
    if not _may_show(light, pitch_px, sensor.arrangement):
        raise ReconstructionError(_refusal(pitch_px, why_not_seen(light, pitch_px)), image="reference")
    progress("searching for bad pixels", 0.1)
    light = repaired(light, find_bad_pixels(reference, dark, blur_px=sensor.blur_px))
    progress("fitting the lattice", 0.25)
    fit, why = _fitted(light, sensor, pitch_px)
    for tried, factor in enumerate(_OTHER_PITCHES, 1):
        if fit is None and why != _blame(sensor.arrangement):
            progress(f"fitting one of {pitch_px * factor:.1f} px pitch", (tried + 1) / 4)
            fit, _ = _fitted(light, sensor, pitch_px * factor)
    if fit is not None and abs(fit.lattice.pitch_px / pitch_px - 1) < REACH:
        return _of_the_sensor(fit, sensor, light.shape)
    if fit is not None:
        why = f"it shows one of {fit.lattice.pitch_px:.1f} px; check sensor.lenslet_pitch_m and pixel_pitch_m"
    raise ReconstructionError(_refusal(pitch_px, why), image="reference")


def _refusal(pitch_px: float, why: str) -> str:
    return f"the reference shows no lattice of {pitch_px:.1f} px pitch: {why}"


def _may_show(light: Image, pitch_px: float, arrangement: Arrangement) -> bool:
    """False if the spectrum shows no lattice of that pitch, its half or double; True with few cells."""
    if light.size < _MANY * pitch_px**2:
        return True
    light = without_peaks(light)
    peaks = (strongest_peak(light, pitch_px * factor, arrangement) for factor in (1.0, *_OTHER_PITCHES))
    return any(is_outstanding(peak) for peak in peaks)


def _fitted(light: Image, sensor: Sensor, pitch_px: float) -> tuple[Fit | None, str]:
    """Fit a lattice of about that pitch to a frame's light (row, column), or return why there is none."""
    if pitch_px < SMALLEST_PITCH_PX or min(light.shape) < 2 * pitch_px:
        return None, "its pitch is too small or too large"
    expected = (sensor.lenslet_rows or _FEW) * (sensor.lenslet_columns or _FEW)
    brightest = max(1, expected // _DARK_AT_MOST)
    peak = strongest_peak(light, pitch_px, sensor.arrangement)
    middle = nominal_lattice(sensor, *light.shape)
    start = replace(middle, pitch_px=max(peak.pitch_px, SMALLEST_PITCH_PX), rotation_rad=peak.rotation_rad)
    fit = fit_lattice(light, start, brightest)
    if fit is not None and None in {sensor.lenslet_rows, sensor.lenslet_columns}:
        brightest = max(brightest, int(np.count_nonzero(fit.match.is_lit)) // _DARK_AT_MOST)
        fit = fit_lattice(light, fit.lattice, brightest)
    why = why_no_lattice(fit, peak, light, brightest)
    if not why:
        return fit, why
    if seems_to_be_other(peak, strongest_peak(light, pitch_px, _OTHER[sensor.arrangement])):
        why = _blame(sensor.arrangement)
    return None, why


def _blame(arrangement: Arrangement) -> str:
    """Reason why there is no lattice of an arrangement: the other one is there."""
    other = _OTHER[arrangement]
    return f'it seems to show a {other} one: set lattice.arrangement = "{other}"'


def _light(reference: Counts, sensor: Sensor, dark: Counts | None, full_scale: float) -> Image:
    """Check the reference and return its light above the dark."""
    if reference.ndim != 2 or 0 in reference.shape:
        raise ReconstructionError("the reference is not an image of rows x columns", image="reference")
    rows, columns = reference.shape
    if min(rows, columns) < 2 * sensor.lenslet_pitch_px * (1 - REACH):
        raise ReconstructionError(
            f"not even 2 x 2 lenslets of {sensor.lenslet_pitch_px:.1f} px fit on {rows} x {columns} pixels: check"
            " sensor.lenslet_pitch_m and pixel_pitch_m",
            image="reference",
        )
    if dark is not None and np.shape(dark) != reference.shape:
        raise ReconstructionError("the dark has another size than the reference", image="dark")
    for image, name in ((reference, "reference"), (dark, "dark")):
        if image is not None and not np.isfinite(image).all():
            raise ReconstructionError(f"the {name} holds values that are not finite", image=name)
    require_unsaturated(int(np.count_nonzero(reference >= full_scale)), reference.size, "reference")
    light = np.asarray(reference, np.float32) - np.float32(0 if dark is None else dark)
    if np.ptp(light) == 0:
        raise ReconstructionError("the reference shows no lattice: all its pixels are alike", image="reference")
    return light


def _of_the_sensor(fit: Fit, sensor: Sensor, shape: tuple[int, int]) -> Survey:
    """Choose the sensor's lenslets among the cells of the fit."""
    origins = ((0, 0), (0, 1))[: 1 if sensor.arrangement == "square" else 2]
    blocks = [_Grid(fit, origin, sensor).block(shape) for origin in origins]
    most = max(block.light for block in blocks) - _ALIKE[sensor.arrangement]
    best = min((block for block in blocks if block.light >= most), key=lambda block: (block.size, block.away_px))
    grid, center_px = best.grid, best.center_px.tolist()
    beside = np.full((*grid.lit.shape, 2), np.nan)
    off_lattice = np.concatenate([fit.off_lattice, fit.partial_off_lattice])
    beside[grid.place] = off_lattice @ fit.lattice.pitch_matrix_px
    beside[~grid.lit] = np.nan
    rows, columns = _extent(grid.lit)
    lit = grid.lit[best.slices]
    return Survey(
        sensor=replace(sensor, lenslet_rows=lit.shape[0], lenslet_columns=lit.shape[1]),
        lattice=replace(fit.lattice, center_x_px=center_px[0], center_y_px=center_px[1]),
        rows=rows.stop - rows.start,
        columns=columns.stop - columns.start,
        illuminated=lit,
        displacement_px=beside[best.slices],
        typical=fit.match.typical,
        likeness=float(np.median(fit.match.likeness[fit.match.is_lit])),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """As many rows and columns of cells as the sensor has lenslets."""

    grid: "_Grid"
    slices: tuple[slice, slice]  # of the grid
    center_px: Floats  # (xy,)
    size: int  # number of cells
    light: float  # lit rows and columns
    away_px: float  # from the frame's middle


class _Grid:
    """Cells of a fit in rows and columns, counted from one of them; hexagonal ones from an even row on.

    Absent cells surround them, so that a block of the sensor's rows and columns may begin anywhere.
    """

    def __init__(self, fit: Fit, origin: tuple[int, int], sensor: Sensor) -> None:
        self._lattice, self._sensor = fit.lattice, sensor
        self._origin = fit.lattice.cell_positions(np.array(origin))
        index = np.concatenate([fit.cells.index, fit.partial.index]) - origin
        if origin[1] % 2:
            index[:, 0] -= index[:, 1] % 2  # rows that lay to the left of the origin's row lie to its right
        self._step = 1 if sensor.arrangement == "square" else 2  # from a row that may be the first to the next
        around = np.array([sensor.lenslet_columns or 0, sensor.lenslet_rows or 0])
        self._first = index.min(axis=0) - around
        self._first[1] -= self._first[1] % self._step
        columns, rows = index.max(axis=0) + around - self._first + 1
        column, row = (index - self._first).T
        self.place = row, column
        self.lit = np.zeros((rows, columns), np.bool_)
        self.lit[self.place] = np.concatenate([fit.match.is_lit, fit.partial_is_lit])

    def block(self, shape: tuple[int, int]) -> _Block:
        """Block of the sensor's rows and columns with most light, the nearest to the middle of a `shape`.

        It holds all lit cells if it is large enough; of omitted counts, as many as they need.
        """
        wanted, allowed, occupied = list[int](), list[Booleans](), list[Floats]()
        steps, given = (self._step, 1), (self._sensor.lenslet_rows, self._sensor.lenslet_columns)
        for axis, (lit, step, count) in enumerate(zip(_extent(self.lit), steps, given, strict=True)):
            wanted.append(count or max(lit.stop - lit.start + lit.start % step, 2))
            start = np.arange(self.lit.shape[axis] - wanted[axis] + 1)
            fits = start % step == 0
            holds_all = fits & (start <= lit.start) & (start + wanted[axis] >= lit.stop)
            allowed.append(holds_all if holds_all.any() else fits)
            occupied.append(_occupied(self.lit, 1 - axis, wanted[axis]))
        may_begin, light = np.logical_and.outer(*allowed), np.add.outer(*occupied)
        corner = np.moveaxis(np.indices(light.shape)[::-1], 0, -1) + self._first  # (row, column, xy)
        first_lenslet = self._origin + self._lattice.cell_positions(corner)
        middle = first_lenslet - lenslet_centers(self._lattice.arrangement, *wanted)[0, 0]
        center_px = self._lattice.camera_px(middle)
        away_px = np.hypot(*np.moveaxis(center_px - (np.array(shape[::-1]) - 1) / 2, -1, 0))
        alike = may_begin & (light >= light[may_begin].max() - _ALIKE[self._lattice.arrangement])
        best = np.unravel_index(np.argmin(np.where(alike, away_px, np.inf)), light.shape)
        rows, columns = (slice(int(start), int(start) + count) for start, count in zip(best, wanted, strict=True))
        return _Block(
            self, (rows, columns), center_px[best], math.prod(wanted), float(light[best]), float(away_px[best])
        )


def _extent(lit: Booleans) -> tuple[slice, slice]:
    """Rows and columns of the largest patch of lit cells, across shadows of up to two cells."""
    patches, count = ndimage.label(ndimage.binary_dilation(lit, np.ones((3, 3), np.bool_)))
    patches *= lit
    sizes = np.bincount(patches.ravel(), minlength=count + 1)[1:]
    rows, columns = ndimage.find_objects(patches)[int(np.argmax(sizes))]
    return rows, columns


def _occupied(lit: Booleans, axis: int, wanted: int) -> Floats:
    """Lit rows (or columns) in each block of `wanted`, (block,); one that is half lit counts fully."""
    count = lit.sum(axis=axis)
    usual = np.median(np.sort(count)[-wanted:])
    return np.convolve(np.minimum(1, count / max(_OCCUPIED * usual, 1)), np.ones(wanted), "valid")

"""Search for the lenslet lattice in a reference.

The light of each cell repeats that of its neighbours. The spectrum gives rough pitch and rotation; the phases of the
cells' first harmonics, then the comparison of the cells with the typical one, refine them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
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
    without_peaks,
)

_DARK_AT_MOST = 8  # largest ratio of all lenslets to the lit ones
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

    lattice: Lattice  # centred on the sensor's lenslets
    rows: int  # of lit lenslets that lie entirely on the frame, also beyond the sensor's
    columns: int
    illuminated: Booleans  # the sensor's lit lenslets, (lenslet_row, lenslet_column)
    displacement_px: Floats  # of their light from the lattice, NaN where not lit, (lenslet_row, lenslet_column, xy)
    brightness: Floats  # of each lenslet over the typical one's, (lenslet_row, lenslet_column)
    typical: Floats  # light of a lit lenslet over its cell, mean 0, (sample_row, sample_column)
    likeness: float  # median correlation of the lit lenslets' images with the typical one, 1 if all are equal

    @property
    def residual_px(self) -> float:
        """RMS distance of the lit lenslets' light from the lattice."""
        return float(np.sqrt(np.nanmean(np.sum(self.displacement_px**2, axis=-1))))

    @property
    def illuminated_fraction(self) -> float:
        """Share of the sensor's lenslets that are lit."""
        return float(np.mean(self.illuminated))


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
    The subimages must be symmetric on average; otherwise see `fit_lattice` for the centre. The pitch may differ by 15 %
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
        raise ReconstructionError(_refusal(pitch_px, "was the light on?"), image="reference")
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
    brightest = max(1, sensor.lenslet_rows * sensor.lenslet_columns // _DARK_AT_MOST)
    peak = strongest_peak(light, pitch_px, sensor.arrangement)
    middle = nominal_lattice(sensor, *light.shape)
    start = replace(middle, pitch_px=max(peak.pitch_px, SMALLEST_PITCH_PX), rotation_rad=peak.rotation_rad)
    fit = fit_lattice(light, start, brightest)
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
    smallest_px = sensor.lenslet_pitch_px * (1 - REACH)
    row_px = smallest_px * sensor.row_spacing_m / sensor.lenslet_pitch_m
    if rows < sensor.lenslet_rows * row_px - 2 or columns < sensor.lenslet_columns * smallest_px - 2:
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
    require_unsaturated(int(np.count_nonzero(reference >= full_scale)), reference.size, "reference")
    light = np.asarray(reference, np.float32) - np.float32(0 if dark is None else dark)
    if np.ptp(light) == 0:
        raise ReconstructionError("the reference shows no lattice: all its pixels are alike", image="reference")
    return light


def _of_the_sensor(fit: Fit, sensor: Sensor, shape: tuple[int, int]) -> Survey:
    """Choose the sensor's lenslets among the cells of the fit."""
    grids = [_Grid(fit, cell) for cell in ((0, 0), (0, 1))[: 1 if sensor.arrangement == "square" else 2]]
    wanted = (sensor.lenslet_rows, sensor.lenslet_columns)
    blocks = [block for grid in grids if (block := grid.block(wanted, shape)) is not None]
    most = max((block.light for block in blocks), default=0.0)
    lit = (block for block in blocks if block.light >= most - _ALIKE[sensor.arrangement])
    best = min(lit, key=lambda block: block.away_px, default=None)
    grid = grids[0] if best is None else best.grid
    extent = _extent(grid.lit)
    found = [part.stop - part.start for part in extent]
    if best is None or any(_is_cut(*line) for line in zip(extent, grid.lit.shape, wanted, strict=True)):
        raise ReconstructionError(
            f"of the lattice of {fit.lattice.pitch_px:.1f} px only {found[0]} x {found[1]} lenslets lie whole on the"
            f" frame, not the sensor's {wanted[0]} x {wanted[1]}: move the camera, or change sensor.lenslet_rows and"
            " lenslet_columns",
            image="reference",
        )
    brightness, beside = np.zeros(grid.lit.shape), np.full((*grid.lit.shape, 2), np.nan)
    brightness[grid.place], beside[grid.place] = fit.match.brightness, fit.off_lattice * fit.lattice.pitch_px
    beside[~grid.lit] = np.nan
    chosen = best.slices
    center_x_px, center_y_px = best.center_px
    return Survey(
        lattice=replace(fit.lattice, center_x_px=float(center_x_px), center_y_px=float(center_y_px)),
        rows=found[0],
        columns=found[1],
        illuminated=grid.lit[chosen],
        displacement_px=beside[chosen],
        brightness=brightness[chosen],
        typical=fit.match.typical,
        likeness=float(np.median(fit.match.likeness[fit.match.is_lit])),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """As many rows and columns of cells as the sensor has lenslets."""

    grid: "_Grid"
    slices: tuple[slice, slice]  # of the grid
    center_px: Floats  # (xy,)
    light: float  # lit rows and columns
    away_px: float  # from the frame's middle


class _Grid:
    """Cells of a fit in rows and columns, counted from one of them; hexagonal ones from an even row on."""

    def __init__(self, fit: Fit, origin: tuple[int, int]) -> None:
        self._lattice, index = fit.lattice, fit.cells.index - origin
        self._origin = fit.lattice.cell_positions(np.array(origin))
        if origin[1] % 2:
            index[:, 0] -= index[:, 1] % 2  # rows that lay to the left of the origin's row lie to its right
        self._first = index.min(axis=0)
        self._first[1] -= self._first[1] % 2 * (fit.lattice.arrangement == "hexagonal")
        columns, rows = index.max(axis=0) - self._first + 1
        column, row = (index - self._first).T
        self.place = row, column
        self._whole, self.lit = np.zeros((2, rows, columns), np.bool_)
        self._whole[self.place], self.lit[self.place] = True, fit.match.is_lit

    def block(self, wanted: tuple[int, int], shape: tuple[int, int]) -> _Block | None:
        """Block of the `wanted` rows and columns with most light, the nearest to the middle of a `shape`."""
        if wanted[0] > len(self.lit) or wanted[1] > len(self.lit.T):
            return None
        fits = np.array(sliding_window_view(self._whole, wanted).all(axis=(2, 3)))
        arrangement = self._lattice.arrangement
        if arrangement == "hexagonal":
            fits[1::2] = False
        if not fits.any():
            return None
        light = np.add.outer(_occupied(self.lit, 1, wanted[0]), _occupied(self.lit, 0, wanted[1]))
        corner = np.moveaxis(np.indices(fits.shape)[::-1], 0, -1) + self._first  # (row, column, xy)
        first_lenslet = self._origin + self._lattice.cell_positions(corner)
        middle = first_lenslet - lenslet_centers(arrangement, *wanted)[0, 0]
        center_px = self._lattice.to_camera_px(middle * self._lattice.pitch_px)
        away_px = np.hypot(*np.moveaxis(center_px - (np.array(shape[::-1]) - 1) / 2, -1, 0))
        alike = fits & (light >= light[fits].max() - _ALIKE[arrangement])
        row, column = np.unravel_index(np.argmin(np.where(alike, away_px, np.inf)), fits.shape)
        slices = slice(int(row), int(row) + wanted[0]), slice(int(column), int(column) + wanted[1])
        best = row, column
        return _Block(self, slices, center_px[best], float(light[best]), float(away_px[best]))


def _extent(lit: Booleans) -> tuple[slice, slice]:
    """Rows and columns of the largest connected patch of lit cells."""
    patches, count = ndimage.label(lit, np.ones((3, 3)))
    sizes = np.bincount(patches.ravel(), minlength=count + 1)[1:]
    rows, columns = ndimage.find_objects(patches)[int(np.argmax(sizes))]
    return rows, columns


def _is_cut(lit: slice, whole: int, wanted: int) -> bool:
    """True if too few lit rows (or columns) end at one edge, with unlit ones on the other side."""
    return bool(lit.stop - lit.start < wanted < whole and (lit.start == 0) != (lit.stop == whole))


def _occupied(lit: Booleans, axis: int, wanted: int) -> Floats:
    """Lit rows (or columns) in each block of `wanted`, (block,); one that is half lit counts fully."""
    count = lit.sum(axis=axis)
    usual = np.median(np.sort(count)[-wanted:])
    return np.convolve(np.minimum(1, count / max(_OCCUPIED * usual, 1)), np.ones(wanted), "valid")

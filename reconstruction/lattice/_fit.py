"""Fit of pitch, rotation and centre of a lattice to its cells, and whether it is real.

Rough pitch and rotation follow from the spectrum of a frame. A square lattice has two spectral peaks, one for its rows
and one for its columns, a hexagonal one three, 60 degrees apart. They are searched for together, so that neither noise
nor stripes pass for a lattice.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg, ndimage

from reconstruction.arrays import SIGMA_OF_MEDIAN, Booleans, Floats, Image
from reconstruction.frame.spline import spline_coefficients
from reconstruction.geometry import Arrangement, Lattice
from reconstruction.lattice.cells import (
    CellMatch,
    Cells,
    cut,
    match_cells,
    match_partial_cells,
    rough_background,
    without_background,
)
from reconstruction.runtime.opencv import cv2

REACH = 0.16  # relative error of the designed pitch that is searched
_BINNED_PITCH_PX = 12  # pitch after binning; coarser frames would lose the lattice
_FINENESS = 4  # search steps per width of a peak
_PADDING = 2  # zero padding
_BESIDE = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.uint8)  # the four neighbours of a pixel


@dataclass(frozen=True, slots=True, kw_only=True)
class Peak:
    """The lattice with the strongest two or three harmonics."""

    pitch_px: float
    rotation_rad: float  # see `least_rotation_rad`
    strength: tuple[float, ...]  # of its harmonics, over the median

    @property
    def mean_strength(self) -> float:
        """Geometric mean over the harmonics."""
        return math.prod(self.strength) ** (1 / len(self.strength))


def least_rotation_rad(arrangement: Arrangement, rotation_rad: float) -> float:
    """Rotation of a lattice between -45 and 45 degrees, if square, or -15 and 45 degrees, if hexagonal.

    It looks the same after a quarter, or a sixth, of a turn. Neither end of the range is a usual way to mount it.
    """
    period, least = (math.pi / 2, -math.pi / 4) if arrangement == "square" else (math.pi / 3, -math.pi / 12)
    return (rotation_rad - least) % period + least


def strongest_peak(image: Image, pitch_px: float, arrangement: Arrangement) -> Peak:
    """Find the lattice of about `pitch_px` with the strongest spectrum in an image (row, column)."""
    period = 1.0 if arrangement == "square" else math.sqrt(3) / 2  # of the harmonics, in pitches
    binning = max(1, int(pitch_px * period / _BINNED_PITCH_PX))
    light, near_px = _binned(image, binning), pitch_px * period / binning
    amplitude = _amplitude(light, near_px)
    cells = max(light.shape) / near_px
    pitches_px = near_px * np.linspace(1 - REACH, 1 + REACH, int(2 * REACH * _FINENESS * cells) + 8)
    angles = 3 * (int(np.pi / 6 * _FINENESS * cells) + 3)
    angle_rad = (np.arange(2 * angles) / angles - 0.5) * np.pi / 2  # of both harmonics, a quarter turn apart
    frequency = np.stack([np.sin(angle_rad), np.cos(angle_rad)])[:, None] / pitches_px[:, None]  # (row, column)
    frequency = np.where(frequency[1] < 0, -frequency, frequency)  # of a real image, its conjugate
    index = frequency * np.array(_padded(light.shape))[:, None, None]
    strength = ndimage.map_coordinates(amplitude, index, order=1, mode="grid-wrap")
    strength /= max(float(np.median(strength)), float(np.finfo(np.float32).tiny))
    apart = angles if arrangement == "square" else 2 * angles // 3
    harmonics = np.stack([np.roll(strength, -turn, axis=1) for turn in range(0, 2 * angles, apart)])[..., :apart]
    best = np.unravel_index(np.argmax(harmonics.prod(axis=0)), harmonics.shape[1:])
    row_rad = 0.0 if arrangement == "square" else math.pi / 6  # from a harmonic to the nearest row of lenslets
    return Peak(
        pitch_px=float(pitches_px[best[0]]) * binning / period,
        rotation_rad=least_rotation_rad(arrangement, float(angle_rad[best[1]]) - row_rad),
        strength=tuple(float(each) for each in harmonics[:, best[0], best[1]]),
    )


def without_peaks(image: Image) -> Image:
    """Limit each pixel (row, column) to its brightest neighbour: quicker than `find_bad_pixels`."""
    return np.asarray(np.minimum(image, cv2.dilate(image, _BESIDE)))


def _binned(image: Image, binning: int) -> Image:
    """Means over binning x binning pixels; incomplete blocks at the far edges are dropped."""
    rows, columns = (length // binning for length in image.shape)
    blocks = image[: rows * binning, : columns * binning].reshape(rows, binning, columns, binning)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float64), np.float32)


def _padded(shape: tuple[int, ...]) -> list[int]:
    return [fft.next_fast_len(_PADDING * length) for length in shape]


def _amplitude(light: Image, pitch_px: float) -> Image:
    """Amplitude spectrum (row, column), without the background; only the needed columns."""
    repeating = light - ndimage.uniform_filter(light, max(2, round(pitch_px)), mode="mirror")
    for axis, length in enumerate(light.shape):
        fade = np.hanning(length + 2)[1:-1].astype(np.float32)
        repeating *= fade if axis else fade[:, None]
    rows, columns = _padded(light.shape)
    kept = int(columns / (pitch_px * (1 - REACH))) + 2
    return np.asarray(np.abs(fft.fft(fft.rfft(repeating, columns, axis=1)[:, :kept], rows, axis=0)))


_CYCLES = 1 / (2 * np.pi)  # per rad
_ROUGH_ROUNDS, _FINE_ROUNDS = 3, 2
_REWEIGHTINGS = 5
_OUTLYING = 4.685  # standard deviations beyond which a cell has no weight (Tukey's biweight, 95 % efficient)
_FINEST = 1e-6  # pitches; a smaller scatter is rounding
_FEWEST = 2  # lit cells
_NOTHING = 1e-30  # keeps a division from one by zero
SMALLEST_PITCH_PX = 8.0  # limit of `Lattice`
_STRIP = 1 / 32  # of a pitch, width of the strips at the edge and in the middle of a cell
_CONTRAST = 5e-3  # of the typical cell over the frame's range of light; smooth frames have only rounding errors
_RANGE_PERCENT = (0.5, 99.5)  # percentiles of that range
_OUTSTANDING = 4.0  # height of a spectral peak over the median
_ONE_SIDED = 8.0  # ratio of the two peaks
_AGREEMENT = 0.5  # of the phases of the cells' harmonics; noise has about 1 / sqrt(cells)
_ALIKE = 0.5  # correlation of the mean cells of two halves of the frame; noise has about 0
_REPEATED = 0.98  # share of the power of the typical cell in every second (third, fifth) harmonic if it repeats itself
_SCATTER = 0.1  # RMS distance of the cells' light from the lattice, in pitches
_FEWEST_LIT = 3  # lit lenslets
_UNEVEN, _CERTAIN = 0.02, 5.0  # RMS distance from the lattice, in pitches and standard errors, that one pitch leaves
_SMOOTH = 0.2  # correlation of neighbouring pixels below which light is only noise


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A lattice centred on a lenslet, and its cells."""

    lattice: Lattice
    cells: Cells  # whole ones
    match: CellMatch
    agreement: Floats  # of the phases of the cells' harmonics, 1 if equal, (xy,)
    off_lattice: Floats  # distance of each cell's light from the lattice, in pitches, (N, xy)
    partial: Cells  # those that the frame's edge cuts
    partial_is_lit: Booleans  # (n,)
    partial_off_lattice: Floats  # (n, xy)


def fit_lattice(light: Image, start: Lattice, brightest: int) -> Fit | None:
    """Fit the lattice to the light of a frame (row, column), starting from a rough pitch and rotation.

    A lenslet's centre is where the first harmonic of the light of all cells has phase 0 along x and y: the middle of a
    symmetric image. The phase is 180 degrees instead if that puts less light on the edges of the cells, as with a ring.
    At least `brightest` lenslets should be lit. The pitch depends on the direction if that moves lenslets noticeably.
    None if there are no 2 x 2 cells, fewer than two are lit, or the fit leaves the start's pitch.
    """
    coefficients = spline_coefficients(light - rough_background(light, round(start.pitch_px)))
    lattice, sign = start, np.ones(2)
    for rough_round in range(_ROUGH_ROUNDS):
        cells = cut(coefficients, lattice)
        if not _fills_both_axes(cells):
            return None
        harmonics = sign * _evened(cells.harmonics(), brightest)
        # Cells must hold complete images before neighbours can be compared.
        growth = _growth(cells, harmonics) if rough_round else None
        lattice = _moved(lattice, cells.offset(np.angle(harmonics.sum(axis=0)) * _CYCLES), growth)
        for axis in (1, 0) if not rough_round else ():  # half a row is also beside the columns of a hexagonal lattice
            sign[axis] = _sign(cut(coefficients, lattice))[axis]
            lattice = _moved(lattice, cells.offset(np.where(sign < 0, 0.5, 0.0) * (np.arange(2) == axis)))
        if not 1 - 2 * REACH < lattice.pitch_px / start.pitch_px < 1 + 2 * REACH:
            return None
    coefficients = spline_coefficients(light)
    is_even = True  # the pitch is the same in all directions
    for fine_round in range(3 * _FINE_ROUNDS):
        cells = cut(coefficients, lattice)
        if not _fills_both_axes(cells):
            return None
        match = match_cells(cells, brightest=brightest)
        cells = without_background(cells, match.brightness)
        match = match_cells(cells, brightest=brightest)
        typical = replace(cells, index=cells.index[:1], light=match.typical[None].astype(np.float32))
        offset = cells.offset(np.angle(typical.harmonics()[0] * sign) * _CYCLES)
        weight = match.is_lit * np.clip(match.brightness, 0, 1) ** 2
        if np.count_nonzero(weight) < _FEWEST:
            return None
        move, linear, off_lattice = _affinity(cells.position, match.displacement, weight, is_even=is_even)
        lattice = _moved(lattice, move + offset, linear, is_even=is_even)
        if fine_round == _FINE_ROUNDS - 1:
            if not _is_uneven(cells.position, off_lattice, weight):
                break
            is_even = False
    harmonics = _evened(cells.harmonics(), brightest)
    agreement = np.abs(harmonics.sum(axis=0)) / np.maximum(np.abs(harmonics).sum(axis=0), _NOTHING)
    partial = cut(coefficients, cells.lattice, only_partial=True)
    is_lit, displacement = match_partial_cells(partial, light.shape, match, brightest=brightest)
    partial_off_lattice = displacement - move - partial.position @ linear
    return Fit(lattice, cells, match, agreement, off_lattice, partial, is_lit, partial_off_lattice)


def _fills_both_axes(cells: Cells) -> bool:
    return len(cells.index) > 0 and bool(np.all(np.ptp(cells.index, axis=0) >= 1))


def _evened(harmonics: NDArray[np.complex128], brightest: int) -> NDArray[np.complex128]:
    """Limit the harmonics of cells (N, xy) to those of the `brightest`-th: one may be a reflection."""
    size = np.abs(harmonics)
    most = np.sort(size, axis=0)[-min(brightest, len(size))]
    return np.asarray(harmonics * np.minimum(1, most / np.maximum(size, _NOTHING)))


def _growth(cells: Cells, harmonics: NDArray[np.complex128]) -> Floats:
    """Stretch and turn of the lattice as a linear map (2, 2), by the phases of the harmonics (N, xy) of neighbours."""
    first = cells.index.min(axis=0)
    columns, rows = cells.index.max(axis=0) - first + 1
    grid = np.zeros((rows, columns, 2), np.complex128)
    x, y = (cells.index - first).T
    grid[y, x] = harmonics
    apart = 1 if cells.lattice.arrangement == "square" else 2  # rows that lie straight below each other
    along_columns, along_rows = (
        cells.offset(np.angle((one * other.conj()).sum(axis=(0, 1))) * _CYCLES)
        for one, other in ((grid[:, 1:], grid[:, :-1]), (grid[apart:], grid[:-apart]))
    )
    along_rows /= apart * cells.lattice.row_spacing
    stretch, turn = along_columns[0] + along_rows[1], along_columns[1] - along_rows[0]
    return np.array([[stretch, turn], [-turn, stretch]]) / 2


def _sign(cells: Cells) -> Floats:
    """-1 along x or y if the cells have less light in the middle than on the edges, else 1."""
    light = cells.light.mean(axis=0, dtype=np.float64)
    distance = np.abs(cells.steps)
    edge, middle = distance > distance.max() - _STRIP, distance < distance.min() + _STRIP
    along = [light.mean(axis=axis) for axis in (0, 1)]
    return np.array([-1.0 if line[edge].mean() > line[middle].mean() else 1.0 for line in along])


def _affinity(
    position: Floats, displacement: Floats, weight: Floats, *, is_even: bool
) -> tuple[Floats, Floats, Floats]:
    """Robust fit of a move and a linear map (2, 2) of row vectors to displacements (N, xy), in pitches; and residuals.

    An even map stretches all directions alike, and turns.
    """
    counts = weight
    for _ in range(_REWEIGHTINGS):
        counts = counts / counts.sum()
        middle, mean = counts @ position, counts @ displacement
        away, moved = position - middle, displacement - mean
        products, squares = away.T @ (counts[:, None] * moved), away.T @ (counts[:, None] * away)
        if is_even:
            stretch, turn = np.trace(products), products[0, 1] - products[1, 0]
            products, squares = np.array([[stretch, turn], [-turn, stretch]]), np.trace(squares) * np.eye(2)
        linear = np.linalg.pinv(squares, hermitian=True) @ products
        rest = moved - away @ linear
        scatter = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(rest[weight > 0]))), _FINEST)
        outlying = np.minimum(np.hypot(*rest.T) / (_OUTLYING * scatter), 1)
        counts = weight * (1 - outlying**2) ** 2
        if not counts.any():
            counts = weight
    return mean - middle @ linear, linear, rest


def _is_uneven(position: Floats, off_lattice: Floats, weight: Floats) -> bool:
    """True if the cells' light (N, xy) lies noticeably closer to a lattice whose pitch depends on the direction."""
    _, _, left = _affinity(position, off_lattice, weight, is_even=False)
    before, after = (float(np.mean(np.sum(each[weight > 0] ** 2, axis=1))) for each in (off_lattice, left))
    return before - after > max(_UNEVEN**2, _CERTAIN**2 * after / np.count_nonzero(weight))


def _moved(lattice: Lattice, move: Floats, linear: Floats | None = None, *, is_even: bool = True) -> Lattice:
    """Move the lattice by `move` (xy), in pitches along its axes, then map it by 1 + `linear` (2, 2), row vectors."""
    x_px, y_px = lattice.camera_px(move)
    lattice = replace(lattice, center_x_px=float(x_px), center_y_px=float(y_px))
    if linear is None:
        return lattice
    turn, pitches_px = linalg.polar((np.eye(2) + linear) @ lattice.pitch_matrix_px @ lattice.turn, side="left")
    pitch_px, rotation_rad = float(np.trace(pitches_px)) / 2, math.atan2(turn[0, 1], turn[0, 0])
    stretch = float(pitches_px[0, 0] / pitch_px - 1), float(pitches_px[0, 1] / pitch_px)
    return replace(
        lattice,
        pitch_px=max(pitch_px, SMALLEST_PITCH_PX),
        rotation_rad=least_rotation_rad(lattice.arrangement, rotation_rad) if is_even else rotation_rad,
        stretch=None if is_even else stretch,
    )


def why_no_lattice(fit: Fit | None, peak: Peak, light: Image, brightest: int) -> str:
    """Reason to reject the lattice fitted to the light of a frame (row, column); empty if it is real.

    At least `brightest` lenslets must be lit.
    """
    is_lit = np.zeros(1, np.bool_) if fit is None else fit.match.is_lit
    lit = int(np.count_nonzero(is_lit))
    if fit is None or fit.agreement.min() < _AGREEMENT or _halves_alike(fit.cells) < _ALIKE:
        return _why_irregular(peak, lit, light)
    if not fit.match.typical.std() > _CONTRAST * float(np.ptp(np.percentile(light, _RANGE_PERCENT))):
        return why_not_seen(light, peak.pitch_px)
    if lit < (least := max(brightest, _FEWEST_LIT)) or np.any(np.ptp(fit.cells.index[is_lit], axis=0) < 1):
        side_by_side = f"{least} in several rows and columns"
        return (
            f"only {lit} of its lenslets have light, not {side_by_side}: omit sensor.lenslet_rows and lenslet_columns"
        )
    if (scatter := float(np.sqrt(np.mean(np.sum(fit.off_lattice[is_lit] ** 2, axis=-1))))) > _SCATTER:
        return (
            f"spots deviate from a {fit.lattice.arrangement} lattice by {100 * scatter:.0f} % of the pitch, more than"
            f" {100 * _SCATTER:.0f} %: set [lattice] in the bench, from a frame of an undistorted wavefront"
        )
    if _repeats_inside(fit.match.typical):
        return "its cells show the same image more than once; check sensor.lenslet_pitch_m and pixel_pitch_m"
    return ""


def seems_to_be_other(peak: Peak, other: Peak) -> bool:
    """True if the spectrum has the peaks of another arrangement rather than those searched for."""
    return other.mean_strength > max(_OUTSTANDING, peak.mean_strength)


def is_outstanding(peak: Peak) -> bool:
    """True if the spectrum has a peak above the noise."""
    return max(peak.strength) >= _OUTSTANDING


def why_not_seen(light: Image, pitch_px: float) -> str:
    """Reason why the light of a frame (row, column) does not repeat: it is noise, or something else."""
    side = max(round(pitch_px), 2)
    rows, columns = (length // side for length in light.shape)
    squares = light[: rows * side, : columns * side].reshape(rows, side, columns, side)
    squares = squares - squares.mean(axis=(1, 3), keepdims=True)
    neighbours = np.mean(squares[..., 1:] * squares[..., :-1], axis=(1, 3))
    square = np.maximum(np.mean(squares**2, axis=(1, 3)), np.finfo(np.float32).tiny)
    if float(np.median(neighbours / square)) < _SMOOTH:
        return "was the light on?"
    return "its light does not repeat: is the lenslet array in the beam, and the camera in its focus?"


def _why_irregular(peak: Peak, lit: int, light: Image) -> str:
    """Reason why the cells of a frame (row, column), `lit` of which seem lit, differ."""
    if not is_outstanding(peak):
        return why_not_seen(light, peak.pitch_px)
    if max(peak.strength) > _ONE_SIDED * min(peak.strength):
        return "its light repeats in one direction only"
    return why_not_seen(light, peak.pitch_px) if lit < _FEWEST_LIT else "its cells do not show the same image"


def _halves_alike(cells: Cells) -> float:
    """Smallest correlation of the mean cells of two halves: every other column, row, or cell."""
    x, y = cells.index.T
    light = cells.light - cells.light.mean(axis=(1, 2), keepdims=True)
    least = 1.0
    for half in (x % 2 == 0, y % 2 == 0, (x + y) % 2 == 0):
        if half.any() and not half.all():
            one, other = light[half].mean(axis=0), light[~half].mean(axis=0)
            least = min(least, float(np.corrcoef(one.ravel(), other.ravel())[0, 1]))
    return least


def _repeats_inside(typical: Floats) -> bool:
    """True if the typical cell (S, S) holds the same image two, three or five times along x or y."""
    power = np.abs(np.fft.fft2(typical)) ** 2
    order = np.abs(np.fft.fftfreq(len(typical), 1 / len(typical)))
    lines = power.sum(axis=0), power.sum(axis=1)
    return any(line[order % times == 0].sum() > _REPEATED * line.sum() for line in lines for times in (2, 3, 5))

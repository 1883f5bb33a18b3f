"""Quality of a reference and its dark.

Without a sample in the beam all subimages are alike but for what each lenslet does to its own: shifts, blur,
brightness. A sample stretches and shears them, by amounts that neighbours share. So a reference with a sample shows
without a second image, unless the sample lies at the lenslets, where it only shifts.
"""

import math

import numpy as np

from reconstruction.arrays import Booleans, Counts, Floats, Image
from reconstruction.frame.noise import TransferCurve
from reconstruction.frame.pixels import CLIPPED, TOO_BRIGHT, KnownCamera, clipped_fraction
from reconstruction.frame.spline import interpolate
from reconstruction.geometry import Lattice, Sensor, centered_steps, lenslet_centers
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.registration.subimages import DARK_CONTRAST, ReferenceSubimages, structure, typical

_OFF_LATTICE = 0.05  # of a pitch; on the bench of evidence/accuracy.md it changes a wavefront of 4.2 rad by 0.2 rad
_DARK = 0.25  # of the typical lenslet's contrast
_MISSING = 0.25  # of the shorter side of the lattice; as many lenslets more lie elsewhere
_SAMPLES = 16  # across a cell
_LEAK = 0.01  # of the light in the dark; 0.2 changes a wavefront of 4 rad RMS by 0.9 rad
_LOST = 0.25  # of the variance per count; good sensors lose 0.1 near their full well
_DIFFERENT = 0.03  # of the variance per count, between images of one camera


def reference_quality(
    reference: Counts,
    *,
    sensor: Sensor,
    lattice: Lattice,
    shown: Lattice | None = None,
    camera: KnownCamera,
    variance: Image | None = None,
) -> Quality:
    """Judge a reference and its dark, (row, column), counts.

    `lattice` is where the lenslets are taken to be, `shown` where the reference shows them (`lattice.search.survey`).
    `variance` (row, column) is that of the averaged frames, counts^2.
    """
    reasons: dict[Fault, str] = {}
    dark, noise, frames = camera.dark, camera.noise.of_frame, camera.noise.reference_frames
    light = np.asarray(reference, np.float64)
    if dark is not None:
        light = light - dark
    if shown is not None:
        off_px = lattice_error_px(lattice, shown, sensor)
        if off_px > _OFF_LATTICE * lattice.pitch_px:
            reasons[Fault.LATTICE] = (
                f"the reference shows lenslets up to {off_px:.1f} px from [lattice], which is wrong or stale (calibrate"
                " again, or leave [lattice] out), unless the mask is asymmetric (use a [lattice] from a symmetric one)"
            )
        elif (more := lit_elsewhere(light, lattice, shown, sensor)) > _MISSING * min(sensor.lenslets):
            reasons[Fault.LATTICE] = (
                f"the reference shows {more} more lenslets whole pitches away from [lattice], which is wrong or stale"
                " (calibrate again, or leave [lattice] out), unless the mask is asymmetric"
            )
    if dark is not None:
        leak = leaked_light(np.asarray(dark, np.float64), light)
        if leak > _LEAK:
            reasons[Fault.DARK] = (
                "the dark is brighter than the reference: take it again with the light off"
                if leak >= 1
                else f"the dark contains {100 * leak:.0f} % of the reference's light: take it again with the light off"
            )
    scatter = read_noise = 0.0
    if noise is not None:
        scatter = float(np.sqrt(noise.variance(np.max(light, keepdims=True)).item() / frames))
        read_noise = noise.read_noise_counts / math.sqrt(frames)
    clipped = clipped_fraction(reference, scatter=scatter, read_noise=read_noise)
    if clipped > CLIPPED:
        reasons[Fault.CLIPPED] = (
            f"{100 * clipped:.0f} % of the reference's pixels are clipped below the camera's full scale: {TOO_BRIGHT}"
        )
    if variance is not None and frames > 1 and not variance.any():
        reasons[Fault.FROZEN] = "all frames of the reference are identical: the camera repeats one frame"
    return Quality(reasons)


def linearity_quality(curve: TransferCurve | None, image: str) -> Quality:
    """Judge by its noise whether counts of an image, "frame" or "reference", are proportional to light."""
    loss = 0.0 if curve is None else curve.loss
    reason = (
        f"bright counts of the {image} are compressed, by their noise, which is {100 * loss:.0f} % too small: lower the"
        " EM gain or the light, and switch gamma off"
    )
    return Quality.of(Fault.LINEARITY, "" if loss <= _LOST else reason)


def likeness_quality(frame: TransferCurve | None, reference: TransferCurve | None, averaged: float) -> Quality:
    """Judge by noise whether grey values of a frame and a reference, of so many frames, mean the same."""
    differ = 0.0 if frame is None or reference is None else frame.difference(reference, averaged)
    reason = (
        "grey values of the frame and of the reference are not alike, by their noise, which differs by"
        f" {100 * differ:.0f} % in bright pixels: was gamma or the EM gain changed between them?"
    )
    return Quality.of(Fault.LINEARITY, "" if differ <= _DIFFERENT else reason)


def lattice_error_px(lattice: Lattice, other: Lattice, sensor: Sensor) -> float:
    """Largest distance of a lenslet from the nearest lenslet of the other lattice, px.

    Whole pitches do not count: a reference may show more lenslets than the sensor has; see `lit_elsewhere`.
    """
    centers = lenslet_centers(sensor.arrangement, *sensor.lenslets)
    corners = centers[[0, 0, -1, -1], [0, -1, 0, -1]]
    off = other.in_pitches(lattice.camera_px(corners)) - corners
    mean = off.mean(axis=0)
    rows = np.rint(mean[1] / other.row_spacing)
    half = 0.0 if sensor.arrangement == "square" else (rows % 2) / 2
    off -= [np.rint(mean[0] - half) + half, rows * other.row_spacing]
    return float(np.hypot(*off.T).max() * other.pitch_px)


def lit_elsewhere(light: Floats, lattice: Lattice, shown: Lattice, sensor: Sensor) -> int:
    """Number of lenslets that light (row, column), counts, shows in another lattice beyond those in this one."""
    here, there = (_shown(light, each, sensor) for each in (lattice, shown))
    least = _DARK * np.median(there)
    return int(np.count_nonzero(there > least) - np.count_nonzero(here > least))


def lit_lenslets(light: Image, lattice: Lattice, sensor: Sensor) -> Booleans:
    """True for lenslets with an image in the light (row, column), counts, (lenslet_row, lenslet_column)."""
    shown = _shown(light, lattice, sensor, samples=int(lattice.pitch_px))
    return (shown > DARK_CONTRAST * typical(shown)).reshape(sensor.lenslets)


def _shown(light: Image | Floats, lattice: Lattice, sensor: Sensor, samples: int = _SAMPLES) -> Floats:
    """Structure of the light (row, column) in each cell of a lattice, counts, (L,); 0 if it is cut."""
    steps = centered_steps(samples) / samples
    centers = lenslet_centers(sensor.arrangement, *sensor.lenslets).reshape(-1, 1, 2)
    at = centers + np.stack(np.meshgrid(steps, steps * lattice.row_spacing), axis=-1).reshape(-1, 2)
    column, row = np.moveaxis(np.floor(lattice.camera_px(at) + 0.5).astype(np.intp), -1, 0)
    inside = (row >= 0) & (row < light.shape[0]) & (column >= 0) & (column < light.shape[1])
    shown = structure(light[row * inside, column * inside].reshape(-1, samples, samples))
    return np.where(inside.all(axis=1), shown, 0.0)


def leaked_light(dark: Floats, light: Floats) -> float:
    """Share of the reference's light in the dark, by regression; 1 if the dark is brighter.

    Both are (row, column), counts; `light` is the reference minus the dark.
    """
    away = light - light.mean()
    square = float(np.vdot(away, away))
    if light.mean() <= 0 or square == 0:
        return 1.0
    slope = float(np.vdot(away, dark)) / square
    return slope / (1 + slope) if slope > 0 else 0.0


# RMS deformation over the field that neighbours share, px. The paper's bench has 0.17 with its sample of 4.2 rad, 0.009
# with 0.25 rad, and without one at most 0.001 at 200 electrons, or 0.014 where a round pupil cuts lenslets.
_DEFORMED_PX = 0.02
_CHANCE = 2.0  # standard errors of the median that are not counted
_STANDARD_ERROR = 1.86  # of a median, times the square root of the number, over the median absolute deviation
_PASSES = 2  # that measure shifts and take them away


def sample_quality(reference: ReferenceSubimages) -> Quality:
    """Judge whether a reference contains a sample; a point source cannot be stretched."""
    shared_px = shared_deformation_px(reference) if reference.half_width_px > reference.blur_px else 0.0
    reason = f"the reference's subimages are deformed by {shared_px:.2f} px: was the sample in, or is it the frame?"
    return Quality.of(Fault.SAMPLE, "" if shared_px <= _DEFORMED_PX else reason)


def shared_deformation_px(reference: ReferenceSubimages) -> float:
    """RMS linear displacement over the field that neighbouring subimages share, beyond that of all, px.

    That of the whole lattice or of one of its halves, whichever is the most; 0 if there are no neighbours.
    """
    whole = _deformations_px(reference)
    rows, columns = (-(-side // 2) for side in whole.shape[:2])
    parts = (whole, whole[:rows], whole[-rows:], whole[:, :columns], whole[:, -columns:])
    # A third is the mean square of u or v over the field.
    return math.sqrt(max(*map(_shared_square, parts), 0.0) / 3)


def _shared_square(deformations: Floats) -> float:
    """Median product of neighbours' deformations (lenslet_row, lenslet_column, n), px^2, less chance."""
    neighbours = ((deformations[:-1], deformations[1:]), (deformations[:, :-1], deformations[:, 1:]))
    products = np.concatenate([np.sum(one * other, axis=-1).ravel() for one, other in neighbours])
    known = products[np.isfinite(products)]
    if not known.size:
        return 0.0
    median = float(np.median(known))
    return median - _CHANCE * _STANDARD_ERROR * float(np.median(np.abs(known - median))) / math.sqrt(known.size)


def _deformations_px(reference: ReferenceSubimages) -> Floats:
    """Displacement of each subimage from the mean one, per half width of the field, px; NaN where unlit.

    (lenslet_row, lenslet_column, 4): along x and y, proportional to u, then to v.
    """
    lit = reference.lit
    u, v = reference.offset_px.T / reference.half_width_px
    position_px, turn = reference.position_px[lit], reference.turn
    for _ in range(_PASSES):
        light, gradient = interpolate(reference.spline_coefficients, position_px)
        brightness = np.maximum(light.sum(axis=1), np.finfo(np.float32).tiny)[:, None]
        light, mean_gradient = light / brightness, (gradient / brightness[..., None]).mean(axis=0) @ turn.T
        mean = light.mean(axis=0)
        moved = [along * position for position in (u, v, np.ones_like(u)) for along in mean_gradient.T]
        images = np.stack([*moved, mean, mean * u, mean * v, np.full_like(mean, mean.mean())])
        found = (light - mean) @ np.linalg.pinv(images)
        position_px = position_px - found[:, None, 4:6] @ turn
    deformations = np.full((lit.size, 4), np.nan)
    deformations[lit] = found[:, :4]
    return deformations.reshape(*reference.lenslets, 4)

"""Accuracy of a source mask, predicted before it is manufactured.

Residual without noise: the bench's screen changes the image of each lenslet to first order, light that it gathers
included, and the registration turns that change into displacements. Noise: the Cramer-Rao bound, from the Fisher
information of the reference, and the estimator's error bar. In real light the inside of a uniform area shows no
displacement: where a mask hides some, the bound is large, and only the layers of the sample determine the wavefront.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from app.bench.config import Bench
from app.bench.imaging_model import lenslet_image
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames, with_source
from app.files import check_readable
from app.measurement.calibration import Calibration
from app.progress import Progress, named
from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.modes.polynomials import legendre_projection
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.quality.information import layered_information, wavefront_bound
from reconstruction.reconstructor import NOISE_MODES, Reconstructor
from reconstruction.registration.response import WarpRegistration, mean_subimage
from reconstruction.settings import ReconstructionSettings, RegistrationSettings, Warp
from reconstruction.wavefront import mean_rms
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import read_grey_image, source_points
from simulated_devices.sample import Sample
from simulated_devices.settings import MASKS

PEAKS_E = (300.0, 1e3, 1e4)  # electrons in the brightest pixel of the reference
WARP: Warp = "cubic"  # of the noise
_DEGREE = 5  # of the wavefronts over a lenslet, and over the field
_EXACT = 9  # degree of screens that are projected exactly
_BRIGHT = 0.1  # of the highest brightness; darker points are outside the source
_ROUNDING = 1e-9  # half widths of the field


def with_mask(bench: Bench, name: str) -> Bench:
    """Return the bench with a mask of the simulator, or a picture of one: black and white, or grey."""
    if name in bench.simulation.source.masks:
        return with_source(bench, mask=name)
    if not Path(name).exists():
        raise InputError(f"there is no mask and no file {name}: give the file of a picture, or {', '.join(MASKS[:-1])}")
    check_readable(Path(name))
    try:
        read_grey_image(Path(name))
    except ValueError as error:
        raise InputError(f"mask: {error}") from error
    return with_source(bench, mask="image", file=name)


def predicted_accuracies(bench: Bench, progress: Progress) -> dict[str, dict[str, float]]:
    """Predict light and mean errors (rad) of the square and the bench's mask; `InputError` if none is possible."""
    square = NoiseFreeFrames(bench).reference("square")
    found: dict[str, dict[str, float]] = {}
    for mask in dict.fromkeys(("square", bench.simulation.source.mask)):
        try:
            found[mask] = _predicted(with_source(bench, mask=mask), square, named(progress, mask))
        except (InputError, ReconstructionError) as error:
            raise InputError(f"mask {mask}: {error}") from error
    return found


def _predicted(bench: Bench, square: Image, progress: Progress) -> dict[str, float]:
    """Predict for the bench's mask; `square` is the reference with the square, (row, column), for the exposure."""
    views, frames = lit_views(bench), NoiseFreeFrames(bench)
    if not views.any():
        raise InputError("no view lies inside it: check [field] view_spacing_m")
    progress("residual", 0.0)
    frame, reference = frames.frame(), frames.reference()
    reconstructor = calibration_of(bench, reference).reconstructor()
    found = {"light over the square's": float(reference.sum() / square.sum())}
    found["displacements hidden in each lenslet"] = float(reconstructor.hidden)
    displacement = linear_pass(bench, reconstructor, reference)(frames.sample)
    for assumed, sample in (("any wavefront", FREE), ("layers", reconstructor.find_sample(displacement))):
        error = reconstructor.solve(displacement, sample=sample).views - frame.truth
        found[f"residual, {assumed}"] = mean_rms(np.where(displacement.valid, error, np.nan)[views])
    lights = list(product({"": reference.max(), " in the square": square.max()}.items(), PEAKS_E))
    for done, ((label, peak), peak_e) in enumerate(lights, 1):
        progress("noise", done / (len(lights) + 1))
        name, scale = f"noise, {peak_e:g} e-{label}", np.float32(peak_e / peak)
        noise = _noise(bench, reference * scale, frame.photons * scale, views)
        found[f"{name}: bound"], found[f"{name}: error bar"] = noise
    return found


def _noise(bench: Bench, reference: Image, frame: Image, views: Booleans) -> tuple[float, float]:
    """Return bound and error bar, rad, of reference and frame (row, column) in electrons, slow EM read-out."""
    camera = bench.camera_model
    read_noise = math.hypot(camera.em_read_noise_e[0], camera.electrons_per_count / math.sqrt(12))
    noise = CameraNoise(counts_per_electron=1.0, read_noise_counts=read_noise)
    reconstructor = calibration_of(bench, reference, WARP, without_prior(bench), noise).reconstructor()
    wavefront = reconstructor(frame)
    bound = bound_rad(bench, reconstructor, field_modes=wavefront.displacement.modes.count, views=views)
    sigma = np.where(wavefront.displacement.valid, wavefront.sigma(), np.nan)
    return bound, mean_deviation_rad(sigma[views])


def calibration_of(
    bench: Bench,
    reference: Image,
    warp: Warp | None = None,
    reconstruction: ReconstructionSettings | None = None,
    noise: CameraNoise | None = None,
) -> Calibration:
    """Calibrate by a reference (row, column) above the dark, in the unit of the frames; None: chosen automatically."""
    settings, dark = reconstruction or ReconstructionSettings(), np.zeros_like(reference)
    method = replace(bench, registration=RegistrationSettings(warp=warp), reconstruction=settings)
    given = Calibration.of_images(method, reference, dark=dark, lattice=bench.design_lattice(*reference.shape))
    return replace(given, known=KnownNoise(noise))


def without_prior(bench: Bench) -> ReconstructionSettings:
    """Modal reconstruction with 45 modes, or all that the lattice carries: unbiased, as the bound requires."""
    all_modes = len(pupil_modes(bench.sensor, "legendre", None).degree)
    return ReconstructionSettings(pupil_modes=min(NOISE_MODES, all_modes))


def lit_views(bench: Bench) -> Booleans:
    """True for views (view_row, view_column) in the convex hull of points with a tenth of the most brightness."""
    simulation, field = bench.simulation, bench.field
    points = source_points(simulation.source.mask, simulation.source, object_samples=simulation.object_samples)
    try:
        outline = ConvexHull(points.position_m[points.area_m2 > _BRIGHT * points.area_m2.max()]).equations
    except QhullError as error:
        raise InputError("the source is a point or a line: no view lies inside it") from error
    y_m, x_m = np.meshgrid(field.view_y_m, field.view_x_m, indexing="ij")
    distance_m = np.stack([x_m, y_m], axis=-1) @ outline[:, :2].T + outline[:, 2]
    return np.asarray(np.all(distance_m <= _ROUNDING * field.half_width_m, axis=-1))


def mean_deviation_rad(deviation: Floats) -> float:
    """Mean of the RMS over the lenslets, (..., lenslet_row, lenslet_column), ignoring NaN."""
    return float(np.mean(np.sqrt(np.nanmean(deviation**2, axis=(-2, -1)))))


def bound_rad(
    bench: Bench,
    reconstructor: Reconstructor,
    *,
    field_modes: int,
    views: Booleans | None = None,
    exposure: float = 1.0,
    brightness_terms: int = 1,
) -> float:
    """Cramer-Rao bound of the scatter for the modes of `without_prior`, from the exact model of the bench.

    The light is that of the reference in `exposure` times its own, the noise that of a frame. The brightness of each
    subimage is unknown in that many polynomials over the field. NaN if the mask shows nothing of some wavefronts.
    """
    if reconstructor.noise is None:
        raise ValueError("without the noise of a frame there is no bound")
    subimages, modes = reconstructor.subimages, pupil_modes(bench.sensor, "legendre", without_prior(bench).pupil_modes)
    model, legendre = true_lenslet(bench, subimages.width), LegendreModes(field_modes)
    _, light = mean_subimage(subimages)
    light = exposure * light / model.image().sum()
    brightness, noise = LegendreModes(brightness_terms), reconstructor.noise
    try:
        found = layered_information(
            model, light, noise, sensor=bench.sensor, modes=modes, field_modes=legendre, brightness=brightness
        )
        bound = wavefront_bound(*found, bench.field, modes, legendre)
    except ReconstructionError:
        return math.nan
    return mean_deviation_rad(bound if views is None else bound[views])


def true_lenslet(bench: Bench, width: int) -> LensletImage:
    """Exact model of one lenslet of the simulated bench, on `width` x `width` pixels."""
    simulation, source = bench.simulation, bench.simulation.source
    points = source_points(source.mask, source, object_samples=simulation.object_samples)
    return lenslet_image(bench, points, width, simulation.pupil_samples)


def linear_pass(bench: Bench, reconstructor: Reconstructor, reference: Image) -> Callable[[Sample], Displacement]:
    """Prepare a pass for screens without noise, to first order; the reference (row, column) is above the dark."""
    registration, at_rest = reconstructor.registration_for(reference), reconstructor.register(reference)
    if not isinstance(registration, WarpRegistration):
        raise TypeError("only a registration that fits warps has a response")
    model = true_lenslet(bench, reconstructor.subimages.width)
    modes = LegendreModes((_DEGREE + 1) * (_DEGREE + 2) // 2)
    x, y = model.position.T
    derivatives = model.derivatives(_DEGREE, modes.values(x, y), modes.gradients(x, y))
    response = registration.response(model.image(), derivatives) @ registration.parameters
    rows, columns = at_rest.coefficients.shape[:2]

    def displacement(sample: Sample) -> Displacement:
        found = np.einsum("lnmqk,lnmq->lk", response, local_screen(sample, bench, modes), optimize=True)
        found = np.swapaxes(found.reshape(rows, columns, 2, -1), 2, 3)
        return replace(at_rest, coefficients=at_rest.coefficients + found)

    return displacement


def local_screen(sample: Sample, bench: Bench, modes: LegendreModes) -> Floats:
    """Return the light's phase over each lenslet, rad, (lenslet, n, m, field_mode).

    It is that of wavefronts P_m(xi) P_n(eta) T_q, and 0 beyond degree 5. The projection is exact up to rounding for
    screens that are polynomials of that degree.
    """
    nodes, project = legendre_projection(_DEGREE, _EXACT)
    light, rays, sensor, half_m = sample.light, sample.light.ray_map, bench.sensor, bench.sensor.lenslet_pitch_m / 2

    def along(center_m: Floats) -> Floats:
        """Positions in the light's plane, (lenslet, pupil node, field node)."""
        u_m = center_m[:, None, None] + half_m * nodes[:, None]
        return np.asarray(rays.pupil_scale * u_m + rays.field_scale * bench.field.half_width_m * nodes)

    x_m, y_m = along(sensor.pupil_x_m), along(sensor.pupil_y_m)
    along_y, along_x = light.phase.basis(y_m.ravel(), 0), light.phase.basis(x_m.ravel(), 1)
    phase = np.asarray(along_y @ light.phase.coefficients @ along_x.T).reshape(*y_m.shape, *x_m.shape)
    series = np.einsum("rjvcih,jn,im,vb,ha->rcnmba", phase, project, project, project, project, optimize=True)
    local = np.einsum("rcnmba,qba->rcnmq", series, modes.products)
    n, m = np.indices(local.shape[2:4])
    local[:, :, n + m > _DEGREE] = 0
    return np.asarray(local.reshape(-1, *local.shape[2:]))

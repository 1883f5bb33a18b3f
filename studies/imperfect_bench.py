"""An imperfect bench: each imperfection alone, and all together, in real light.

The reference and the frame have the imperfections, the bench's settings do not. Those of the optics are fields at the
lenslets, apart from the wavelengths: each has its own images, which add up.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from app.acquisition.devices import scene_of
from app.bench.config import Bench
from app.evaluation.frames import seeded, with_screen, with_source
from app.evaluation.mask_accuracy import mean_deviation_rad
from reconstruction.arrays import Floats, Image, PointField
from reconstruction.errors import ReconstructionError
from reconstruction.layers.layered_wavefront import FREE
from reconstruction.wavefront import without_piston
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.rendering import Renderer
from studies.estimators import EmCamera, camera, residual, row, warp_estimator, without_wavefront
from studies.tables import Asked, Made, Row, curves, draw_curves, steps

_PEAK_E = 1e5  # electrons in the reference's brightest pixel: noise counts little
_DEGREE = 4  # of a lenslet's aberrations
_HALO_PX = 20.0  # sigma of scattered light
_STREAM = 2  # of the random numbers of a seed


@dataclass(frozen=True, slots=True, kw_only=True)
class Imperfections:
    """Imperfections of a bench, each 0 if there is none."""

    defocus: float = 0.0  # distance of the camera over the focal length of the lenslets, less 1
    aberration_waves: float = 0.0  # RMS over each lenslet, up to the fourth degree, at random
    bandwidth_m: float = 0.0  # of three lines of the source, equally strong, from the middle one to the others
    absorption_rms: float = 0.0  # of the sample, see `Screen.transmission_rms`
    uneven_source: float = 0.0  # change of the brightness from the middle to an edge
    uneven_beam: float = 0.0  # half width of the lenslets over the beam's 1/e^2 radius, a fifth of which is off centre
    lattice_px: float = 0.0  # scatter of the lenslets' axes along x and y
    diffusion_px: float = 0.0  # sigma of the charge in the detector
    prnu: float = 0.0  # scatter of the pixels' gain
    nonlinearity: float = 0.0  # share that is lost of the brightest pixel of the reference
    stray_light: float = 0.0  # share that is scattered widely

    @property
    def of_optics(self) -> "Imperfections":
        """Those of everything before the detector."""
        return replace(self, **dict.fromkeys(_OF_DETECTOR, 0.0))


NONE = Imperfections()
_OF_DETECTOR = "diffusion_px", "prnu", "nonlinearity", "stray_light"
_ALL = Imperfections(
    defocus=0.04,
    aberration_waves=0.03,
    bandwidth_m=10.5e-9,
    absorption_rms=0.16,
    uneven_source=0.25,
    uneven_beam=0.5,
    lattice_px=0.1,
    diffusion_px=0.35,
    prnu=0.008,
    nonlinearity=0.012,
    stray_light=0.02,
)


@dataclass(frozen=True, slots=True)
class Case:
    """One bench."""

    name: str
    imperfections: Imperfections
    knows_distance: bool = False  # the bench's settings have the camera's distance as focal length
    is_calibrated: bool = False  # the camera's nonlinearity was measured
    brightness: float = 1.0  # of the light behind the frame, over that behind the reference


_NAMES = {
    "defocus": "defocus 4 %",
    "aberration_waves": "lenslets 0.03 waves",
    "bandwidth_m": "LED ±10.5 nm",
    "absorption_rms": "absorption 16 %",
    "uneven_source": "source 25 %",
    "uneven_beam": "beam 1/e² at 2 pupils",
    "lattice_px": "lattice 0.1 px",
    "diffusion_px": "diffusion 0.35 px",
    "prnu": "PRNU 0.8 %",
    "nonlinearity": "nonlinear 1.2 %",
    "stray_light": "stray light 2 %",
}
CASES = (
    Case("none", NONE),
    *(Case(name, replace(NONE, **{each: getattr(_ALL, each)})) for each, name in _NAMES.items()),
    Case("absorption 8 %", Imperfections(absorption_rms=0.08)),
    Case("absorption 4 %", Imperfections(absorption_rms=0.04)),
    Case("defocus 0.4 %", Imperfections(defocus=0.004)),
    Case("defocus 4 %, in the settings", Imperfections(defocus=_ALL.defocus), knows_distance=True),
    Case("nonlinear 5 %, frame half as bright", Imperfections(nonlinearity=0.05), brightness=0.5),
    Case("the same, calibrated", Imperfections(nonlinearity=0.05), brightness=0.5, is_calibrated=True),
    Case("all, defocus in the settings", _ALL, knows_distance=True),
)


def imperfect_images(bench: Bench, imperfections: Imperfections) -> tuple[tuple[Image, Image], Floats]:
    """Noise-free reference and frame, (row, column), m^2, of imperfect optics, and the true wavefronts.

    They are of all wavelengths; the truth is the phase at the bench's own, see `Renderer.truth_wavefront`. The
    imperfections of the detector follow, see `detected`.
    """
    focal_length_m = bench.sensor.lenslet_focal_length_m * (1 + imperfections.defocus)
    defocused = with_screen(
        replace(bench, sensor=replace(bench.sensor, lenslet_focal_length_m=focal_length_m)),
        transmission_rms=imperfections.absorption_rms or bench.simulation.screen.transmission_rms,
    )
    scene, offset_m = scene_of(defocused), imperfections.bandwidth_m
    if offset_m:
        scene = replace(scene, lines=tuple((bench.sensor.wavelength_m + n * offset_m, 1 / 3) for n in (-1, 0, 1)))
    whole = Renderer(scene)
    amplitude, phase = _pupil(bench, imperfections, whole.lines[0][1].model)
    images = []
    for share, renderer in whole.lines:
        ratio = bench.sensor.wavelength_m / renderer.scene.sensor.wavelength_m
        points = renderer.points(bench.simulation.source.mask)
        along = points.position_m[:, 0] / bench.field.half_width_m
        points = replace(points, area_m2=points.area_m2 * (1 + imperfections.uneven_source * along))
        pupil = np.asarray(amplitude * np.exp(1j * ratio * phase), np.complex64)
        fields = _through(lambda *_: np.ones((1, 1), np.complex64), pupil), _through(renderer.light(0), pupil)
        images.append([share * renderer.model.irradiance(points, field) for field in fields])
    reference, frame = np.sum(np.array(images), axis=0)
    return (reference, frame), whole.truth_wavefront(0)


def _pupil(bench: Bench, imperfections: Imperfections, model: ForwardModel) -> tuple[Floats, Floats]:
    """Amplitude and phase, rad at the bench's wavelength, that beam and lenslets add, (y, x)."""
    sensor, random = bench.sensor, np.random.default_rng([bench.simulation.seed, _STREAM])
    x_m, y_m, pitch_m = model.sample_x_m, model.sample_y_m, sensor.lenslet_pitch_m
    shape = *sensor.lenslets, _DEGREE + 1, _DEGREE + 1
    n, m = np.indices(shape[2:])
    of_lenslet = random.standard_normal(shape)  # coefficients of P_n(eta) P_m(xi) of unit RMS
    of_lenslet[..., (n + m < 2) | (n + m > _DEGREE)] = 0
    rms_rad = 2 * np.pi * imperfections.aberration_waves
    of_lenslet *= rms_rad / np.sqrt(np.sum(of_lenslet**2, axis=(2, 3), keepdims=True))
    wavenumber, focal_length_m = sensor.wavenumber_rad_per_m, sensor.lenslet_focal_length_m
    slope_rad_per_m = wavenumber * imperfections.lattice_px * sensor.pixel_pitch_m / focal_length_m
    tilt_rad = random.standard_normal((2, *shape[:2])) * slope_rad_per_m * pitch_m / 2 / np.sqrt(3)
    of_lenslet[..., 0, 1], of_lenslet[..., 1, 0] = tilt_rad
    # the lenslet's focus seen by a camera at the distance f (1 + defocus)
    bent = 1 / (1 + imperfections.defocus) - 1
    quadratic = wavenumber / (2 * focal_length_m) * bent * (pitch_m / 2) ** 2
    norm = np.sqrt(2 * np.arange(_DEGREE + 1) + 1)
    of_lenslet *= np.multiply.outer(norm, norm)
    for order in ((0, 2), (2, 0)):
        of_lenslet[..., *order] += quadratic * 2 / 3  # of P_2, apart from a piston
    phase = model.phase_of_lenslets(of_lenslet)
    beam_x, beam_y = (
        imperfections.uneven_beam * along_m / half_m - 0.2 * bool(imperfections.uneven_beam)
        for along_m, half_m in zip((x_m, y_m), sensor.pupil_half_width_m, strict=True)
    )
    return np.exp(-(beam_x**2) - beam_y[:, None] ** 2), phase


def _through(light: PointField, amplitude: NDArray[np.complex64]) -> PointField:
    """Return the light behind a pupil of this amplitude (y, x)."""
    return lambda x_m, y_m: np.asarray(light(x_m, y_m) * amplitude, np.complex64)


def detected(images: tuple[Image, Image], imperfections: Imperfections, seed: int) -> tuple[Image, Image]:
    """Electrons of reference and frame, (row, column), that an imperfect detector collects.

    Its read-out follows, and with it the nonlinearity, see `camera_of`.
    """
    gain = 1 + imperfections.prnu * np.random.default_rng([seed, _STREAM, 1]).standard_normal(images[0].shape)
    scale = _PEAK_E / images[0].max()

    def electrons(image: Image) -> Image:
        scattered = ndimage.gaussian_filter(image, _HALO_PX, mode="constant")
        light = (1 - imperfections.stray_light) * image + imperfections.stray_light * scattered
        light = ndimage.gaussian_filter(light, imperfections.diffusion_px, mode="constant") * scale * gain
        return np.asarray(light, np.float32)

    reference, frame = map(electrons, images)
    return reference, frame


def imperfect_bench(asked: Asked, cases: Sequence[Case] = CASES) -> Made:
    """Residual, error bar and flags for each imperfection of a bench, and for all, behind a checkerboard."""
    bench, rows = asked.bench, list[Row]()
    if bench.simulation.source.mask == "square":
        bench = with_source(bench, mask="checkerboard")
    for screen in seeded(bench, asked.seeds):
        images: dict[Imperfections, tuple[tuple[Image, Image], Floats]] = {}  # detectors' cases have the same optics
        for case in steps(cases, "imperfections"):
            optics = case.imperfections.of_optics
            if optics not in images:
                images[optics] = imperfect_images(screen, optics)
            light, truth = images[optics]
            rows += _measured(screen, case, detected(light, case.imperfections, screen.simulation.seed), truth)
    table = curves(rows)
    title = "Imperfect benches, checkerboard, one pass"
    return table, draw_curves(table, title, "imperfection", left_out="error bar")


def camera_of(bench: Bench, nonlinearity: float) -> EmCamera:
    """Return the bench's camera that loses this share of the brightest pixel of the reference."""
    settings = camera(bench).settings
    whole_e = settings.electrons_per_count * (2**settings.bits - 1)
    return EmCamera(replace(settings, nonlinearity=nonlinearity * whole_e / _PEAK_E))


def _measured(bench: Bench, case: Case, images: tuple[Image, Image], truth: Floats) -> Iterator[Row]:
    """Yield a case's residuals from reference and frame, electrons, (row, column).

    `truth` is in rad, (view_row, view_column, lenslet_row, lenslet_column).
    """
    em_camera, at = camera_of(bench, case.imperfections.nonlinearity), case.name
    if case.is_calibrated:
        bench = replace(bench, linearity=em_camera.linearity(images[0], bench.simulation.seed))
    if case.knows_distance:
        distance_m = bench.sensor.lenslet_focal_length_m * (1 + case.imperfections.defocus)
        bench = replace(bench, sensor=replace(bench.sensor, lenslet_focal_length_m=distance_m))
    reference, seed = em_camera.counts(images[0]), bench.simulation.seed
    frame = em_camera.exposed(images[1] * np.float32(case.brightness), seed, 0)
    estimator = warp_estimator(bench, reference, None, noise=em_camera.noise)
    try:
        displacement = estimator.reconstructor.register(frame)
        samples = {"free": FREE, "layers": estimator.reconstructor.find_sample(displacement)}
    except ReconstructionError:
        yield without_wavefront(estimator, curve="layers", at=at)
        return
    for curve, sample in samples.items():
        wavefront = estimator.reconstructor.solve(displacement, sample=sample)
        flags = estimator.quality_checker(frame, wavefront.displacement).faults.name
        yield {**residual(wavefront, truth, curve=curve, at=at), "flags": flags or ""}
        valid, sigma = wavefront.displacement.valid, wavefront.sigma()
        error = without_piston(np.where(valid, wavefront.views - truth, np.nan))
        coverage = float(np.mean((np.abs(error) < sigma)[np.isfinite(error)]))
        bar_rad = mean_deviation_rad(np.where(valid, sigma, np.nan))
        yield row(wavefront, bar_rad, curve=f"{curve}: error bar", at=at, coverage=coverage)

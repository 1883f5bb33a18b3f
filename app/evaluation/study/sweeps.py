"""Sweeps over phase screen, source, light, gain, and benches that differ from their settings."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from app.bench.config import Bench
from app.bench.imaging_model import by_pixel
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrame, NoiseFreeFrames, seeded, simulating, with_screen, with_source
from app.evaluation.studies import CaseResult
from app.evaluation.study.estimators import (
    AUTOMATIC,
    FAST,
    REFINED,
    SLOW,
    WARPS,
    EmCamera,
    camera,
    compare,
    compared,
    warp_estimator,
    warp_estimators,
    with_rms,
)
from app.evaluation.study.noise_limit import Scatter, bound_rad, scatter_of, without_prior
from app.evaluation.study_kinds import Sweep
from app.measurement.estimator import ROUNDS, Estimator
from app.progress import Progress
from reconstruction.arrays import Image
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Lattice
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.settings import ReconstructionSettings, Warp
from reconstruction.wavefront import Wavefront, mean_rms
from simulated_devices.optics.source import source_points
from simulated_devices.sample import make_sample
from simulated_devices.settings import Mask

_Measure = Callable[[Bench, range, Progress], Iterator[CaseResult]]
_Change = Callable[[Bench, float], Bench]


def _over_screens(values: tuple[float, ...], change: _Change, first_seed: int | None = None) -> _Measure:
    """Measure noise-free frames of the changed bench against the reference of the unchanged one."""

    def measure(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
        estimators = warp_estimators(bench, NoiseFreeFrames(bench).reference())
        for done, screen in enumerate(seeded(bench, seeds, first_seed)):
            for index, value in enumerate(values):
                progress(f"{value:g}", (done + index / len(values)) / len(seeds))
                frame = NoiseFreeFrames(change(screen, value)).frame()
                yield from compare(estimators, frame.photons, frame.truth, at=value)

    return measure


SIZE = Sweep(
    name="size",
    title="Strength of the wavefronts",
    axis="wavefront RMS (rad)",
    measure=_over_screens(
        (0.5, 1.0, 2.0, 4.2, 6.0, 8.0, 10.0, 12.0, 15.0), lambda bench, rms_rad: with_screen(bench, rms_rad=rms_rad)
    ),
    is_logarithmic=True,
)
ROUGHNESS = Sweep(
    name="roughness",
    title="Roughness of the screen",
    axis="correlation length (mm)",
    axis_per_si=1e3,
    measure=_over_screens(
        (1.0e-3, 1.25e-3, 1.6e-3, 2.0e-3, 2.5e-3, 3.0e-3, 4.0e-3),
        lambda bench, length_m: with_screen(bench, correlation_length_m=length_m),
    ),
    is_logarithmic=True,
)
# The screen of the experiment, 20 mm behind the mask.
NEAR_SOURCE: dict[str, Any] = {
    "placement": "source",
    "distance_m": 0.02,
    "correlation_length_m": 1.2e-3,
    "samples": 481,
    "sample_spacing_m": 5e-6,
}
EXPERIMENT = Sweep(
    name="experiment",
    title="Screen 20 mm behind the mask",
    axis="wavefront RMS (rad)",
    measure=_over_screens(
        (5.0, 10.0, 15.0, 20.0, 30.0, 40.0),
        lambda bench, rms_rad: with_screen(bench, **NEAR_SOURCE, rms_rad=rms_rad),
        first_seed=0,
    ),
    is_logarithmic=True,
)

_CORRELATION_LENGTHS_M = (1.25e-3, 1.6e-3, 2.0e-3)
_ENSEMBLE_WARPS: tuple[Warp, ...] = ("translation", *WARPS)
_METHODS = {
    "zonal": ReconstructionSettings(method="zonal"),
    "modal 45": ReconstructionSettings(pupil_modes=45),
    "modal 66": ReconstructionSettings(pupil_modes=66),
    "modal 91": ReconstructionSettings(pupil_modes=91),
    "automatic": AUTOMATIC,
}
_DRIFT_RAD_PER_S = 0.3  # change of the wavefront, mean RMS over the views
_STEP_M = 10e-6  # screen shift that measures the change per metre


def _ensembles(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    """Measure every warp in one pass, then over the layers found, refined, and refined live."""
    reference = NoiseFreeFrames(bench).reference()
    films = []
    for index, length_m in enumerate(_CORRELATION_LENGTHS_M):
        for done, screen in enumerate(seeded(with_screen(bench, correlation_length_m=length_m), seeds)):
            progress(f"rendering {length_m * 1e3:g} mm", (index + done / len(seeds)) / len(_CORRELATION_LENGTHS_M) / 2)
            drifting = NoiseFreeFrames(_drifting(screen))
            films.append((length_m, [drifting.frame(state=age_s) for age_s in reversed(range(ROUNDS + 1))]))
    methods = list(product(_ENSEMBLE_WARPS, _METHODS.items()))
    for index, (warp, (method, reconstruction)) in enumerate(methods):
        progress(f"{warp}, {method}", (1 + index / len(methods)) / 2)
        try:
            estimator = warp_estimator(bench, reference, warp, reconstruction=reconstruction)
            register, solve = estimator.reconstructor.register, estimator.reconstructor.solve
        except ReconstructionError:  # too many modes for so few lenslets
            continue
        for length_m, film in films:
            displacement, truth = register(film[-1].photons), film[-1].truth
            yield compared(solve(displacement), truth, curve=f"{warp}, {method}", at=length_m)
            if method != "automatic" or warp not in REFINED:
                continue
            sample = estimator.reconstructor.find_sample(displacement)
            wavefronts = {
                "layers": solve(displacement, sample=sample),
                "live": _live(estimator, film, sample, is_refined=False),
                f"refined {ROUNDS}x": estimator.solve(displacement, sample=sample, rounds=ROUNDS)[0],
                "refined live, 1 s old": _live(estimator, film, sample, is_refined=True),
            }
            for name, wavefront in wavefronts.items():
                yield compared(wavefront, truth, curve=f"{warp}, {name}", at=length_m)


def _live(
    estimator: Estimator, film: Sequence[NoiseFreeFrame], sample: AssumedSample, *, is_refined: bool
) -> Wavefront:
    """Follow a film to its last frame as the acquisition does.

    Each frame is registered from the displacement of the one before it; refined, it is corrected by that one's bias.
    """
    reconstructor = estimator.reconstructor
    displacement = reconstructor.register(film[0].photons)
    wavefront, bias = reconstructor.solve(displacement, sample=sample), None
    for frame in film[1:]:
        if is_refined:
            bias = estimator.refinement.bias(wavefront).displacement
        displacement = reconstructor.register(frame.photons, start=displacement)
        wavefront = reconstructor.solve(displacement, bias=bias, sample=sample)
    return wavefront


def _drifting(bench: Bench) -> Bench:
    """The bench with a drifting screen; its state k is k seconds old."""
    sample = make_sample(bench.simulation, bench.sensor, bench.field)
    here, there = (sample.wavefront((shift_m, shift_m)) for shift_m in (0.0, _STEP_M / math.sqrt(2)))
    speed_m_per_s = _DRIFT_RAD_PER_S / mean_rms(here - there) * _STEP_M
    # rounded, so that its frames are cached
    along_m_per_s = float(np.format_float_scientific(speed_m_per_s / math.sqrt(2), 3))
    drifting = with_screen(bench, drift_x_m_per_s=along_m_per_s, drift_y_m_per_s=along_m_per_s)
    return simulating(drifting, drifting_states=ROUNDS + 1, state_duration_s=1.0)


ENSEMBLES = Sweep(
    name="ensembles",
    title="The ensembles",
    axis="correlation length (mm)",
    axis_per_si=1e3,
    left_out=("modal",),
    measure=_ensembles,
    # of the preset's square
    limits_rad={"quartic, layers": dict(zip(_CORRELATION_LENGTHS_M, (0.055, 0.036, 0.026), strict=True))},
)

_MASKS: tuple[Mask, ...] = ("square", "checkerboard", "circle", "octagon", "ellipse", "peaks")
_BRIGHT = 0.1  # of the highest brightness; darker points are outside the source
_ROUNDING = 1e-9  # half widths of the field


def _sources(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    for index, mask in enumerate(_MASKS):
        with_mask = with_source(bench, mask=mask)
        views = lit_views(with_mask)
        estimators = warp_estimators(with_mask, NoiseFreeFrames(with_mask).reference())
        for done, screen in enumerate(seeded(with_mask, seeds)):
            progress(mask, (index + done / len(seeds)) / len(_MASKS))
            frame = NoiseFreeFrames(screen).frame()
            yield from compare(estimators, frame.photons, frame.truth, at=mask, views=views)


def lit_views(bench: Bench) -> NDArray[np.bool_]:
    """True for views within the outline of the source, (view_row, view_column).

    The outline is the convex hull of the points with a tenth of the highest brightness.
    """
    simulation, field = bench.simulation, bench.field
    points = source_points(simulation.source.mask, simulation.source, object_samples=simulation.object_samples)
    bright = points.area_m2 > _BRIGHT * points.area_m2.max()
    try:
        outline = ConvexHull(points.position_m[bright]).equations  # outward normal and offset of each side
    except QhullError as error:
        raise InputError("the source is a point or a line: no view lies inside it") from error
    y_m, x_m = np.meshgrid(field.view_y_m, field.view_x_m, indexing="ij")
    distance_m = np.stack([x_m, y_m], axis=-1) @ outline[:, :2].T + outline[:, 2]
    return np.asarray(np.all(distance_m <= _ROUNDING * field.half_width_m, axis=-1))


SOURCE = Sweep(name="source", title="Source (views inside it)", axis="shape", measure=_sources)

_DEAD = (0.0, 0.05, 0.1, 0.2, 0.3)  # shares of the lenslets


def _over_errors(values: tuple[float, ...], errors: dict[str, _Change]) -> _Measure:
    """Reconstruct frames with the settings of a wrong bench, for each kind and size of error."""

    def measure(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
        reference = NoiseFreeFrames(bench).reference()
        frames = [NoiseFreeFrames(screen).frame() for screen in seeded(bench, seeds)]
        cases = [(kind, value, wrong) for kind, wrong in errors.items() for value in values]
        for done, (kind, value, wrong) in enumerate(cases):
            progress(f"{kind} {value:g}", done / len(cases))
            estimators = warp_estimators(wrong(bench, value), reference, ("quadratic", "cubic"))
            for frame in frames:
                yield from compare(
                    estimators, frame.photons, frame.truth, at=value, prefix=f"{kind}: ", refined=("cubic",)
                )

    return measure


def _lattice(bench: Bench) -> Lattice:
    return bench.design_lattice(bench.camera_model.rows, bench.camera_model.columns)


def _with_lattice(bench: Bench, name: str, change: Callable[[float, float], float]) -> Bench:
    """Change one number of the lattice; `change` gets it and the distance of the outermost lenslet, px."""
    lattice, lenslets = _lattice(bench), max(bench.sensor.lenslet_rows, bench.sensor.lenslet_columns)
    changed: Any = change(getattr(lattice, name), (lenslets - 1) / 2 * lattice.pitch_px)
    return replace(bench, lattice=replace(lattice, **{name: changed}))


def _with_length(section: str, name: str, bench: Bench, error: float) -> Bench:
    """Change a length of a section by a relative error."""
    settings = getattr(bench, section)
    changed: Any = replace(settings, **{name: getattr(settings, name) * (1 + error)})
    return replace(bench, **{section: changed})


_LATTICE_ERRORS: dict[str, _Change] = {  # by the shift of the outermost lenslets
    "centre": lambda bench, px: _with_lattice(bench, "center_x_px", lambda center_px, _: center_px + px),
    "pitch": lambda bench, px: _with_lattice(bench, "pitch_px", lambda pitch_px, far_px: pitch_px * (1 + px / far_px)),
    "rotation": lambda bench, px: _with_lattice(bench, "rotation_rad", lambda angle, far_px: angle + px / far_px),
}
LATTICE = Sweep(
    name="lattice",
    title="Lattice wrong in centre, pitch or rotation",
    axis="error at the outermost lenslets (px)",
    measure=_over_errors((0.0, 0.5, 1.0, 2.0, 3.0), _LATTICE_ERRORS),
)
FOCAL_LENGTH = Sweep(
    name="focal_length",
    title="Focal lengths wrong",
    axis="relative error",
    measure=_over_errors(
        (-0.05, -0.02, 0.0, 0.02, 0.05),
        {
            "lenslets": partial(_with_length, "sensor", "lenslet_focal_length_m"),
            "collimator": partial(_with_length, "field", "collimator_focal_length_m"),
        },
    ),
)


def _dead(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    reference = NoiseFreeFrames(bench).reference()
    shape = bench.sensor.lenslet_rows, bench.sensor.lenslet_columns
    for done, screen in enumerate(seeded(bench, seeds)):
        frame = NoiseFreeFrames(screen).frame()
        order = np.random.default_rng(screen.simulation.seed).permutation(shape[0] * shape[1])
        for index, fraction in enumerate(_DEAD):
            progress(f"{fraction:.0%} dead", (done + index / len(_DEAD)) / len(seeds))
            alive = np.ones(order.size)
            alive[order[: round(fraction * order.size)]] = 0.0
            alive = alive.reshape(shape)
            light = by_pixel(alive, _lattice(bench), *reference.shape)
            estimators = warp_estimators(bench, reference * light)
            yield from compare(estimators, frame.photons * light, frame.truth, at=fraction, refined=("cubic",))
            if fraction > 0:
                cubic, curve = estimators["cubic"], "cubic refined, at the dead ones"
                displacement = cubic.reconstructor.register(frame.photons * light)
                wavefront, _ = cubic.solve(displacement, sample=FREE, rounds=ROUNDS)
                yield compared(wavefront, frame.truth, curve=curve, at=fraction, lenslets=alive == 0.0)


DEAD = Sweep(name="dead", title="Dead lenslets", axis="part of all lenslets", measure=_dead)

_PEAKS_E = (100.0, 300.0, 1e3, 3e3, 1e4, 1e5)  # electrons in the frame's brightest pixel
_GAINS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)  # of the EM register
_DIM_PEAKS_E = (100.0, 300.0, 1000.0)
_DRAWS = 3  # of noise per screen
_LIMITED_E = (300.0, 1e3, 3e3, 1e4, 1e5)  # light levels at which scatter and bound are compared
_NOISE_DRAWS = 67  # of each screen for scatter and coverage: with three screens, 200
_UNBIASED: tuple[Warp, ...] = ("quadratic", "cubic", "quartic")
_OVER_BOUND = 1.1  # limit of scatter over bound


def _photons(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    em_camera, reference = camera(bench), NoiseFreeFrames(bench).reference()
    for done, screen in enumerate(seeded(bench, seeds)):
        seed, frame = screen.simulation.seed, NoiseFreeFrames(screen).frame()
        for index, peak_e in enumerate(_PEAKS_E):
            progress(f"{peak_e:g} electrons", (done + index / len(_PEAKS_E)) / len(seeds))
            scale = np.float32(peak_e / frame.photons.max())
            estimators = warp_estimators(bench, em_camera.counts(reference * scale), noise=em_camera.noise)
            automatic = em_camera.reconstructor(bench, reference * scale)
            for draw in range(_DRAWS):
                noisy = em_camera.exposed(frame.photons * scale, seed, draw)
                yield from compare(estimators, noisy, frame.truth, at=peak_e)
                yield compared(automatic(noisy), frame.truth, curve="automatic warp", at=peak_e)
            if peak_e in _LIMITED_E:
                lit = replace(frame, photons=frame.photons * scale)
                yield from _beside_bound(screen, em_camera, reference * scale, lit, at=peak_e)


def _beside_bound(
    bench: Bench, em_camera: EmCamera, reference: Image, frame: NoiseFreeFrame, *, at: float
) -> Iterator[CaseResult]:
    """Scatter, Cramer-Rao bound and error bar of each warp, and the error bar of the automatic estimator.

    Reference and frame are in electrons, (row, column). The draws of noise are others than those of the residual.
    """

    def wavefronts() -> Iterator[Wavefront]:
        for draw in range(_NOISE_DRAWS):
            yield reconstructor(em_camera.exposed(frame.photons, bench.simulation.seed, _DRAWS + draw))

    for warp in _UNBIASED:
        reconstructor = em_camera.reconstructor(bench, reference, warp, reconstruction=without_prior(bench))
        curve = f"{warp}, 45 modes"
        without = reconstructor(em_camera.counts(frame.photons))
        fields, terms = without.displacement.modes.count, reconstructor.brightness_terms
        bound = bound_rad(bench, reconstructor, field_modes=fields, brightness_terms=terms)
        scatter = scatter_of(wavefronts(), without.views)
        most_rad = _OVER_BOUND * bound
        yield with_rms(without, scatter.rms_rad, curve=f"{curve}: scatter", at=at, asked_rad=most_rad)
        yield with_rms(without, bound, curve=f"{curve}: bound", at=at)
        yield _error_bar(without, scatter, curve, at)
    reconstructor = em_camera.reconstructor(bench, reference)
    scatter = scatter_of(wavefronts(), frame.truth)
    without = reconstructor(em_camera.counts(frame.photons))
    yield _error_bar(without, scatter, "automatic warp", at)


def _error_bar(wavefront: Wavefront, scatter: Scatter, curve: str, at: float) -> CaseResult:
    bar_rad, coverage = scatter.error_bar_rad, scatter.coverage
    return with_rms(wavefront, bar_rad, curve=f"{curve}: error bar", at=at, coverage=coverage)


def _em_gain(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    settings = [(f"37 e- read noise, {peak_e:g} e-", FAST, gain, peak_e) for peak_e in _DIM_PEAKS_E for gain in _GAINS]
    settings += [(f"8 e- read noise, {peak_e:g} e-", SLOW, 1.0, peak_e) for peak_e in _DIM_PEAKS_E]
    reference = NoiseFreeFrames(bench).reference()
    for done, screen in enumerate(seeded(bench, seeds)):
        seed, frame = screen.simulation.seed, NoiseFreeFrames(screen).frame()
        for index, (curve, speed, gain, peak_e) in enumerate(settings):
            progress(f"{curve}, gain {gain:g}", (done + index / len(settings)) / len(seeds))
            em_camera = camera(bench, speed, gain)
            scale = np.float32(peak_e / frame.photons.max())
            reconstructor = em_camera.reconstructor(bench, reference * scale, "quadratic")
            for draw in range(_DRAWS):
                wavefront = reconstructor(em_camera.exposed(frame.photons * scale, seed, draw))
                yield compared(wavefront, frame.truth, curve=curve, at=gain)


PHOTONS = Sweep(
    name="photons",
    title="Light, with 8 e- of read noise",
    axis="electrons in the brightest pixel",
    measure=_photons,
    is_logarithmic=True,
    limits_rad={"cubic refined": {1e3: 0.035}},
)
EM_GAIN = Sweep(
    name="em_gain", title="Gain of the register (quadratic)", axis="gain", measure=_em_gain, is_logarithmic=True
)

SWEEPS = ENSEMBLES, ROUGHNESS, SIZE, EXPERIMENT, PHOTONS, EM_GAIN, SOURCE, LATTICE, FOCAL_LENGTH, DEAD

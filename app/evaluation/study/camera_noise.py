"""Sweeps over the camera's noise: amount of light, and gain of the electron-multiplying register."""

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from app.bench.config import Bench
from app.evaluation.cases import CaseResult
from app.evaluation.noise_free import NoiseFreeFrame, NoiseFreeFrames, seeded
from app.evaluation.study.estimators import WarpEstimator, WarpEstimators, compared, with_rms
from app.evaluation.study.noise_limit import bound_rad, scatter_of, without_prior
from app.evaluation.study_kinds import Sweep
from app.progress import Progress
from reconstruction.arrays import Floats, Image
from reconstruction.frame.noise import CameraNoise
from reconstruction.pipeline import Reconstructor
from reconstruction.settings import Warp
from reconstruction.wavefront import Wavefront
from simulated_devices.detector import Detector, Exposure
from simulated_devices.settings import SimulatedCameraSettings

_PEAKS_E = (100.0, 300.0, 1e3, 3e3, 1e4, 1e5)  # electrons in the frame's brightest pixel
_GAINS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
_DIM_PEAKS_E = (100.0, 300.0, 1000.0)
_DRAWS = 3  # of noise per screen
_FAST, _SLOW = 3, 1  # read-out speeds of the EM amplifier: high and low read noise
_LIMITED_E = (300.0, 1e3, 3e3, 1e4, 1e5)  # light levels at which scatter and bound are compared
_NOISE_DRAWS = 67  # of each screen for scatter and coverage: with three screens, 200
_UNBIASED: tuple[Warp, ...] = ("quadratic", "cubic", "quartic")
_OVER_BOUND = 1.1  # limit of scatter over bound


@dataclass(frozen=True, slots=True)
class EmCamera:
    """The bench's EMCCD in one setting."""

    settings: SimulatedCameraSettings

    @property
    def noise(self) -> CameraNoise:
        """Noise of its pixels; the register turns one electron into G on average, with variance G (G - 1)."""
        settings = self.settings
        read_e = settings.em_read_noise_e[settings.readout_speed - 1]
        rounding_e = settings.electrons_per_count / math.sqrt(12)
        return CameraNoise(
            counts_per_electron=settings.em_gain / settings.electrons_per_count,
            read_noise_counts=math.hypot(read_e, rounding_e) / settings.electrons_per_count,
            excess_noise=2 - 1 / settings.em_gain,
        )

    def counts(self, electrons: Image) -> Image:
        """Mean counts above the offset from electrons before the register."""
        return np.asarray(electrons * np.float32(self.noise.counts_per_electron))

    def exposed(self, electrons: Image, seed: int, index: int) -> Image:
        """Counts above the offset of one noisy frame."""
        settings = self.settings
        exposure = Exposure(
            index=index,
            exposure_s=settings.exposure_s,
            amplifier=settings.amplifier,
            readout_speed=settings.readout_speed,
            em_gain=settings.em_gain,
        )
        with closing(Detector(settings, seed=seed)) as detector:
            counts = detector.counts(electrons / np.float32(settings.quantum_efficiency), exposure)
        return np.asarray(counts - np.float32(settings.offset_counts), np.float32)


def camera(bench: Bench, speed: int, em_gain: float) -> EmCamera:
    """Return the bench's camera with another read-out speed and gain."""
    exposure_s = 1.0  # allowed at every speed; the light follows from the electrons
    return EmCamera(
        replace(bench.camera_model, amplifier="em", readout_speed=speed, em_gain=em_gain, exposure_s=exposure_s)
    )


def _photons(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    em_camera = camera(bench, _SLOW, 1.0)
    for done, (screen, reference, frame) in enumerate(_screens(bench, seeds)):
        seed = screen.simulation.seed
        for index, peak_e in enumerate(_PEAKS_E):
            progress(f"{peak_e:g} electrons", (done + index / len(_PEAKS_E)) / len(seeds))
            scale = np.float32(peak_e / frame.photons.max())
            known = em_camera.counts(reference * scale)
            draws = [em_camera.exposed(frame.photons * scale, seed, draw) for draw in range(_DRAWS)]
            estimators = WarpEstimators(bench, known, noise=em_camera.noise)
            for noisy in draws:
                yield from estimators.compare(noisy, frame.truth, peak_e)
            automatic = WarpEstimator(bench, known, None, noise=em_camera.noise)
            for noisy in draws:
                yield compared("automatic warp", peak_e, automatic.reconstructor(noisy), frame.truth)
            if peak_e in _LIMITED_E:
                noise = _Noise(em_camera, known, frame.photons * scale, frame.truth, seed, _NOISE_DRAWS)
                yield from _beside_bound(screen, noise, peak_e)


@dataclass(frozen=True, slots=True, eq=False)
class _Noise:
    """Noisy frames of one screen at one light level."""

    camera: EmCamera
    reference: Image  # counts, without noise
    electrons: Image
    truth: Floats
    seed: int
    draws: int

    def wavefronts(self, reconstructor: Reconstructor) -> Iterator[Wavefront]:
        """Wavefront of each draw; others than those of the residual's draws."""
        for draw in range(self.draws):
            yield reconstructor(self.camera.exposed(self.electrons, self.seed, _DRAWS + draw))


def _beside_bound(bench: Bench, noise: _Noise, peak_e: float) -> Iterator[CaseResult]:
    """Scatter, Cramer-Rao bound and error bar of each warp, and the error bar of the automatic estimator."""
    mask, model = bench.simulation.source.mask, noise.camera.noise
    for warp in _UNBIASED:
        estimator = WarpEstimator(bench, noise.reference, warp, reconstruction=without_prior(bench), noise=model)
        reconstructor, curve = estimator.reconstructor, f"{warp}, 45 modes"
        without = reconstructor(noise.camera.counts(noise.electrons))
        field_modes = without.displacement.modes.count
        bound = bound_rad(bench, mask, reconstructor, field_modes)
        scatter = scatter_of(noise.wavefronts(reconstructor), without.views)
        yield with_rms(f"{curve}: scatter", peak_e, without, scatter.rms_rad, asked_rad=_OVER_BOUND * bound)
        yield with_rms(f"{curve}: bound", peak_e, without, bound)
        yield with_rms(f"{curve}: error bar", peak_e, without, scatter.error_bar_rad, coverage=scatter.coverage)
    reconstructor = WarpEstimator(bench, noise.reference, None, noise=model).reconstructor
    scatter = scatter_of(noise.wavefronts(reconstructor), noise.truth)
    without = reconstructor(noise.camera.counts(noise.electrons))
    yield with_rms("automatic warp: error bar", peak_e, without, scatter.error_bar_rad, coverage=scatter.coverage)


def _em_gain(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    settings = [(f"37 e- read noise, {peak_e:g} e-", _FAST, gain, peak_e) for peak_e in _DIM_PEAKS_E for gain in _GAINS]
    settings += [(f"8 e- read noise, {peak_e:g} e-", _SLOW, 1.0, peak_e) for peak_e in _DIM_PEAKS_E]
    for done, (screen, reference, frame) in enumerate(_screens(bench, seeds)):
        seed = screen.simulation.seed
        for index, (curve, speed, gain, peak_e) in enumerate(settings):
            progress(f"{curve}, gain {gain:g}", (done + index / len(settings)) / len(seeds))
            em_camera = camera(bench, speed, gain)
            scale = np.float32(peak_e / frame.photons.max())
            known = em_camera.counts(reference * scale)
            estimator = WarpEstimator(bench, known, "quadratic", noise=em_camera.noise)
            for draw in range(_DRAWS):
                wavefront = estimator.reconstructor(em_camera.exposed(frame.photons * scale, seed, draw))
                yield compared(curve, gain, wavefront, frame.truth)


def _screens(bench: Bench, seeds: range) -> Iterator[tuple[Bench, Image, NoiseFreeFrame]]:
    """Bench, reference and frame of each screen."""
    mask = bench.simulation.source.mask
    for screen in seeded(bench, seeds):
        frames = NoiseFreeFrames(screen)
        yield screen, frames.reference(mask), frames.frame(mask)


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

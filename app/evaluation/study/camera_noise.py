"""Sweeps over the camera's noise: amount of light, and gain of the electron-multiplying register."""

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from app.bench.config import Bench
from app.evaluation.cases import CaseResult
from app.evaluation.noise_free import NoiseFreeFrame, NoiseFreeFrames, seeded
from app.evaluation.study.estimators import WarpEstimator, WarpEstimators, compared, mean_rms, with_rms
from app.evaluation.study_kinds import Sweep
from app.progress import Progress
from reconstruction.arrays import Image
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise
from reconstruction.settings import ReconstructionSettings
from reconstruction.wavefront import Wavefront
from simulated_devices.detector.emccd import Detector, Exposure
from simulated_devices.settings import SimulatedCameraSettings

_PEAKS_E = (100.0, 300.0, 1e3, 3e3, 1e4, 1e5)  # electrons in the frame's brightest pixel
_GAINS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
_DIM_PEAKS_E = (100.0, 300.0, 1000.0)
_DRAWS = 3  # of noise per screen
_FAST, _SLOW = 3, 1  # read-out speeds of the EM amplifier: high and low read noise
_PAPER = ReconstructionSettings(pupil_modes=45)


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


def _photons(bench: Bench, seeds: int, progress: Progress) -> Iterator[CaseResult]:
    em_camera = camera(bench, _SLOW, 1.0)
    for done, (seed, reference, frame) in enumerate(_screens(bench, seeds)):
        for index, peak_e in enumerate(_PEAKS_E):
            progress(f"{peak_e:g} electrons", (done + index / len(_PEAKS_E)) / seeds)
            scale = np.float32(peak_e / frame.photons.max())
            known, mean = em_camera.counts(reference * scale), em_camera.counts(frame.photons * scale)
            draws = [em_camera.exposed(frame.photons * scale, seed, draw) for draw in range(_DRAWS)]
            estimators = WarpEstimators(bench, known, noise=em_camera.noise)
            for noisy in draws:
                yield from estimators.compare(noisy, frame.truth, peak_e)
            automatic = WarpEstimator(bench, known, None, noise=em_camera.noise)
            for noisy in draws:
                yield compared("automatic warp", peak_e, automatic.reconstructor(noisy), frame.truth)
            try:
                paper = WarpEstimator(bench, known, "quadratic", reconstruction=_PAPER, noise=em_camera.noise)
            except ReconstructionError:  # too many modes for so few lenslets
                continue
            without = paper.reconstructor(mean)
            for noisy in draws:
                yield from _share_of_noise(peak_e, paper.reconstructor(noisy), without, frame)


def _share_of_noise(
    peak_e: float, wavefront: Wavefront, without: Wavefront, frame: NoiseFreeFrame
) -> Iterator[CaseResult]:
    """Residual, its part from noise, and the predicted error bar; `without` is the wavefront without noise."""
    curve = "quadratic, modal 45"
    valid = wavefront.displacement.valid & without.displacement.valid
    yield compared(curve, peak_e, wavefront, frame.truth)
    yield with_rms(f"{curve}: its noise", peak_e, wavefront, mean_rms(wavefront.views - without.views, valid))
    sigma = wavefront.sigma()[..., valid]
    predicted_rad = float(np.mean(np.sqrt(np.mean(sigma**2, axis=-1))))
    yield with_rms(f"{curve}: its error bar", peak_e, wavefront, predicted_rad)


def _em_gain(bench: Bench, seeds: int, progress: Progress) -> Iterator[CaseResult]:
    settings = [(f"37 e- read noise, {peak_e:g} e-", _FAST, gain, peak_e) for peak_e in _DIM_PEAKS_E for gain in _GAINS]
    settings += [(f"8 e- read noise, {peak_e:g} e-", _SLOW, 1.0, peak_e) for peak_e in _DIM_PEAKS_E]
    for done, (seed, reference, frame) in enumerate(_screens(bench, seeds)):
        for index, (curve, speed, gain, peak_e) in enumerate(settings):
            progress(f"{curve}, gain {gain:g}", (done + index / len(settings)) / seeds)
            em_camera = camera(bench, speed, gain)
            scale = np.float32(peak_e / frame.photons.max())
            known = em_camera.counts(reference * scale)
            estimator = WarpEstimator(bench, known, "quadratic", noise=em_camera.noise)
            for draw in range(_DRAWS):
                wavefront = estimator.reconstructor(em_camera.exposed(frame.photons * scale, seed, draw))
                yield compared(curve, gain, wavefront, frame.truth)


def _screens(bench: Bench, seeds: int) -> Iterator[tuple[int, Image, NoiseFreeFrame]]:
    """Seed, reference and frame of each screen."""
    mask = bench.simulation.source.mask
    for screen in seeded(bench, seeds):
        frames = NoiseFreeFrames(screen)
        yield screen.simulation.seed, frames.reference(mask), frames.frame(mask)


PHOTONS = Sweep(
    name="photons",
    title="Light, with 8 e- of read noise",
    axis="electrons in the brightest pixel",
    measure=_photons,
    is_logarithmic=True,
    limits_rad={"quadratic, modal 45: its noise": {300.0: 0.057, 1e3: 0.020, 1e4: 0.012}},
)
EM_GAIN = Sweep(
    name="em_gain", title="Gain of the register (quadratic)", axis="gain", measure=_em_gain, is_logarithmic=True
)

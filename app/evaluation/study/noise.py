"""Camera noise: the bench's camera, scatter of estimators beside the Cramer-Rao bound, sweeps over light and gain."""

import math
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.evaluation.frames import NoiseFreeFrame, NoiseFreeFrames, exposure_of, seeded
from app.evaluation.studies import CaseResult, Sweep
from app.evaluation.study.estimators import compare, compared, warp_estimator, warp_estimators, with_rms
from app.progress import Progress
from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.frame.linearity import Exposures, Linearity
from reconstruction.frame.noise import CameraNoise
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.modes.pupil_modes import pupil_modes
from reconstruction.pipeline import NOISE_MODES, Reconstructor
from reconstruction.quality.information import layered_information, wavefront_bound
from reconstruction.registration.response import mean_subimage
from reconstruction.settings import ReconstructionSettings, Warp
from reconstruction.wavefront import Wavefront, without_piston
from simulated_devices.detector import Detector
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import source_points
from simulated_devices.settings import SimulatedCameraSettings

_PEAKS_E = (100.0, 300.0, 1e3, 3e3, 1e4, 1e5)  # electrons in the frame's brightest pixel
_GAINS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)  # of the EM register
_DIM_PEAKS_E = (100.0, 300.0, 1000.0)
_DRAWS = 3  # of noise per screen
FAST, SLOW = 3, 1  # read-out speeds of the EM amplifier: high and low read noise
_LIMITED_E = (300.0, 1e3, 3e3, 1e4, 1e5)  # light levels at which scatter and bound are compared
_NOISE_DRAWS = 67  # of each screen for scatter and coverage: with three screens, 200
_UNBIASED: tuple[Warp, ...] = ("quadratic", "cubic", "quartic")
_FILL, _SHARES, _EXPOSURE_DRAWS = 0.8, tuple(np.geomspace(0.1, 1, 8).tolist()), 4  # exposures for the nonlinearity
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
        """Mean counts above the offset from electrons (row, column) before the register."""
        signal = electrons * np.float32(self.settings.em_gain)
        signal -= np.float32(self.settings.loss_per_e) * signal**2
        return np.asarray(signal / np.float32(self.settings.electrons_per_count))

    def linearity(self, electrons: Image, seed: int) -> Linearity:
        """Nonlinearity as `svwfs calibrate --linearity` finds it, from exposures of an image (row, column) in e-."""
        settings, index = self.settings, count()
        full_scale = 2**settings.bits - 1 - settings.offset_counts
        longest = electrons * np.float32(_FILL * full_scale / self.counts(electrons).max())

        def averaged(share: float) -> tuple[Image, Image]:
            draws = [self.exposed(longest * np.float32(share), seed, next(index)) for _ in range(_EXPOSURE_DRAWS)]
            return np.mean(draws, axis=0), np.var(draws, axis=0, ddof=1) / _EXPOSURE_DRAWS

        exposures = Exposures(averaged(1.0)[0], full_scale)
        for share in (*_SHARES, *_SHARES[::-1]) * 2:
            exposures.add(*averaged(share), share)
        return exposures.fit().linearity

    def exposed(self, electrons: Image, seed: int, index: int) -> Image:
        """Counts above the offset of one noisy frame of an image (row, column), electrons."""
        settings = self.settings
        with closing(Detector(settings, seed=seed)) as detector:
            photons = electrons / np.float32(settings.quantum_efficiency)
            counts = detector.counts(photons, exposure_of(settings, index))
        return np.asarray(counts - np.float32(settings.offset_counts), np.float32)

    def reconstructor(self, bench: Bench, electrons: Image, warp: Warp | None = None, **more: Any) -> Reconstructor:
        """Prepare the reconstruction against a reference without noise."""
        return warp_estimator(bench, self.counts(electrons), warp, noise=self.noise, **more).reconstructor


def camera(bench: Bench, speed: int = SLOW, em_gain: float = 1.0) -> EmCamera:
    """Return the bench's camera with another read-out speed and gain; its exposure is allowed at every speed."""
    return EmCamera(replace(bench.camera_model, amplifier="em", readout_speed=speed, em_gain=em_gain, exposure_s=1.0))


def _photons(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    em_camera = camera(bench)
    for done, (screen, reference, frame) in enumerate(_screens(bench, seeds)):
        seed = screen.simulation.seed
        for index, peak_e in enumerate(_PEAKS_E):
            progress(f"{peak_e:g} electrons", (done + index / len(_PEAKS_E)) / len(seeds))
            scale = np.float32(peak_e / frame.photons.max())
            draws = [em_camera.exposed(frame.photons * scale, seed, draw) for draw in range(_DRAWS)]
            estimators = warp_estimators(bench, em_camera.counts(reference * scale), noise=em_camera.noise)
            for noisy in draws:
                yield from compare(estimators, noisy, frame.truth, peak_e)
            automatic = em_camera.reconstructor(bench, reference * scale)
            for noisy in draws:
                yield compared("automatic warp", peak_e, automatic(noisy), frame.truth)
            if peak_e in _LIMITED_E:
                light = reference * scale, frame.photons * scale
                yield from _beside_bound(screen, em_camera, *light, frame.truth, peak_e)


def _beside_bound(
    bench: Bench, em_camera: EmCamera, reference: Image, frame: Image, truth: Floats, peak_e: float
) -> Iterator[CaseResult]:
    """Scatter, Cramer-Rao bound and error bar of each warp, and the error bar of the automatic estimator.

    `reference` and `frame` are in electrons. The draws of noise are others than those of the residual.
    """

    def wavefronts() -> Iterator[Wavefront]:
        for draw in range(_NOISE_DRAWS):
            yield reconstructor(em_camera.exposed(frame, bench.simulation.seed, _DRAWS + draw))

    for warp in _UNBIASED:
        reconstructor = em_camera.reconstructor(bench, reference, warp, reconstruction=without_prior(bench))
        curve = f"{warp}, 45 modes"
        without = reconstructor(em_camera.counts(frame))
        fields, terms = without.displacement.modes.count, reconstructor.brightness_terms
        bound = bound_rad(bench, reconstructor, fields, brightness_terms=terms)
        scatter = scatter_of(wavefronts(), without.views)
        yield with_rms(f"{curve}: scatter", peak_e, without, scatter.rms_rad, asked_rad=_OVER_BOUND * bound)
        yield with_rms(f"{curve}: bound", peak_e, without, bound)
        yield with_rms(f"{curve}: error bar", peak_e, without, scatter.error_bar_rad, coverage=scatter.coverage)
    reconstructor = em_camera.reconstructor(bench, reference)
    scatter = scatter_of(wavefronts(), truth)
    without = reconstructor(em_camera.counts(frame))
    yield with_rms("automatic warp: error bar", peak_e, without, scatter.error_bar_rad, coverage=scatter.coverage)


def _em_gain(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    settings = [(f"37 e- read noise, {peak_e:g} e-", FAST, gain, peak_e) for peak_e in _DIM_PEAKS_E for gain in _GAINS]
    settings += [(f"8 e- read noise, {peak_e:g} e-", SLOW, 1.0, peak_e) for peak_e in _DIM_PEAKS_E]
    for done, (screen, reference, frame) in enumerate(_screens(bench, seeds)):
        seed = screen.simulation.seed
        for index, (curve, speed, gain, peak_e) in enumerate(settings):
            progress(f"{curve}, gain {gain:g}", (done + index / len(settings)) / len(seeds))
            em_camera = camera(bench, speed, gain)
            scale = np.float32(peak_e / frame.photons.max())
            reconstructor = em_camera.reconstructor(bench, reference * scale, "quadratic")
            for draw in range(_DRAWS):
                wavefront = reconstructor(em_camera.exposed(frame.photons * scale, seed, draw))
                yield compared(curve, gain, wavefront, frame.truth)


def _screens(bench: Bench, seeds: range) -> Iterator[tuple[Bench, Image, NoiseFreeFrame]]:
    for screen in seeded(bench, seeds):
        frames = NoiseFreeFrames(screen)
        yield screen, frames.reference(), frames.frame()


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


Views = NDArray[np.bool_] | None  # the views that count, (view_row, view_column); None: all of them


@dataclass(frozen=True, slots=True)
class Scatter:
    """Means over the views of the RMS over the lenslets."""

    rms_rad: float  # standard deviation over the draws
    error_bar_rad: float  # as the estimator predicts it
    coverage: float  # share of the lenslets and draws within one error bar of the expected wavefront


def without_prior(bench: Bench) -> ReconstructionSettings:
    """Modal reconstruction with 45 modes, or all that the lattice carries: unbiased, as the bound requires."""
    all_modes = len(pupil_modes(bench.sensor, "legendre", None).degree)
    return ReconstructionSettings(pupil_modes=min(NOISE_MODES, all_modes))


def scatter_of(wavefronts: Iterable[Wavefront], expected: Floats, views: Views = None) -> Scatter:
    """Scatter of the wavefronts of several draws of noise, at least two.

    `expected` (view_row, view_column, lenslet_row, lenslet_column), rad.
    """
    errors, sigmas = [], []
    for wavefront in wavefronts:
        valid = wavefront.displacement.valid
        errors.append(without_piston(np.where(valid, wavefront.views - expected, np.nan)))
        sigmas.append(np.where(valid, wavefront.sigma(), np.nan))
    error, sigma = np.array(errors), np.array(sigmas)
    if views is not None:
        error, sigma = error[:, views], sigma[:, views]
    known = np.isfinite(error)
    draws, error_or_0 = np.count_nonzero(known, axis=0), np.where(known, error, 0.0)
    with np.errstate(invalid="ignore"):  # lenslets lost in every draw
        mean = error_or_0.sum(axis=0) / draws
        variance = np.sum(np.where(known, error - mean, 0.0) ** 2, axis=0) / (draws - 1)
    covered = float(np.mean((np.abs(error) < sigma)[known]))
    return Scatter(_mean_rms(np.sqrt(variance)), _mean_rms(sigma), covered)


def error_bar_rad(wavefront: Wavefront, views: Views = None) -> float:
    """Error bar of a wavefront: mean over the views of the RMS over the lenslets."""
    sigma = np.where(wavefront.displacement.valid, wavefront.sigma(), np.nan)
    return _mean_rms(sigma if views is None else sigma[views])


def bound_rad(
    bench: Bench,
    reconstructor: Reconstructor,
    field_modes: int,
    views: Views = None,
    *,
    exposure: float = 1.0,
    brightness_terms: int = 1,
) -> float:
    """Cramer-Rao bound of `Scatter.rms_rad` for the modes of `without_prior`, from the exact model of the bench.

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
    return _mean_rms(bound if views is None else bound[views])


def true_lenslet(bench: Bench, width: int) -> LensletImage:
    """Exact model of one lenslet of the simulated bench, on `width` x `width` pixels."""
    simulation = bench.simulation
    return LensletImage(
        bench.sensor,
        bench.field,
        source_points(simulation.source.mask, simulation.source, object_samples=simulation.object_samples),
        width=width,
        pupil_samples=simulation.pupil_samples,
        pixel_fill_factor=bench.camera_model.pixel_fill_factor,
    )


def _mean_rms(deviation: Floats) -> float:
    """Mean of the RMS over the lenslets, (..., lenslet_row, lenslet_column), ignoring NaN."""
    return float(np.mean(np.sqrt(np.nanmean(deviation**2, axis=(-2, -1)))))

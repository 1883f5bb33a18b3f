"""Estimator: everything that turns the frames of one calibration into measurements."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TypeAlias

from app.bench.imaging_model import BenchModel
from app.cache import kept_while_alive
from app.measurement.averages import Average
from app.measurement.calibration import Calibration, surveyed
from app.measurement.mask_scale import scale_quality
from app.measurement.measurement import Assumptions, Measurement, RefinementState
from app.timing import Timings
from drivers.interface import Frame
from reconstruction.arrays import Counts
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Lattice, Sensor
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.quality.frame_quality import QualityChecker
from reconstruction.quality.reference_quality import (
    likeness_quality,
    linearity_quality,
    reference_quality,
    sample_quality,
)
from reconstruction.quality.verdict import Fault, Quality, repeated_reference, sequence_quality
from reconstruction.reconstructor import Reconstructor
from reconstruction.refinement import Refinement, Round
from reconstruction.runtime.threads import THREADS
from reconstruction.settings import FIELD_MODES
from reconstruction.wavefront import Wavefront

ROUNDS = 3  # of refinement, where nobody chooses

Solve: TypeAlias = Callable[[Displacement], tuple[Wavefront, Assumptions]]


class Estimator:
    """Reconstructor, judge, refinement of a calibration, prepared at first use; `ReconstructionError` if impossible."""

    def __init__(self, calibration: Calibration, *, threads: int = THREADS) -> None:
        """`threads` render the forward model; only a single one always rounds alike."""
        self.calibration, self._threads = calibration, threads

    @cached_property
    def reconstructor(self) -> Reconstructor:
        """Registers frames, finds the sample, and solves."""
        return self.calibration.reconstructor()

    @cached_property
    def quality_checker(self) -> QualityChecker:
        """Judges frames by their displacements; the calibration itself is judged already."""
        made, given, shown = self.reconstructor, self.calibration, None
        if given.bench.lattice is not None:
            shown = _shown_lattice(given.reference, given.dark, given.bench.sensor, given.full_scale)
        of_reference = reference_quality(
            given.reference.mean,
            sensor=made.sensor,
            lattice=made.lattice,
            shown=shown,
            camera=made.camera,
            variance=given.reference.variance,
        )
        return QualityChecker(
            made.subimages,
            made.registration,
            camera=made.camera,
            of_reference=(sample_quality(made.subimages) if made.registration.fits_warps else Quality())
            | given.linearity_quality
            | linearity_quality(made.camera.noise.curve, "reference")
            | of_reference
            | scale_quality(given)
            | Quality.of(Fault.RESPONSE, made.response_problem),  # named first
        )

    @cached_property
    def model(self) -> BenchModel:
        """Forward model of the bench."""
        with _refusals():
            return BenchModel(self.calibration.bench, self.reconstructor, threads=self._threads)

    @cached_property
    def refinement(self) -> Refinement:
        """Refines wavefronts with the model."""
        with _refusals():
            return Refinement(self.reconstructor, self.model)

    def quality(self, counts: Counts, displacement: Displacement) -> Quality:
        """Judge an image (row, column) by its displacements, and by its noise unless averages show that."""
        judged, given = self.quality_checker(counts, displacement), self.calibration
        if given.known is None:
            return judged
        curve, alike = given.transfer_of(counts), Quality()
        if given.dark is not None:  # without it, uneven stray light bends the noise of two images differently
            alike = likeness_quality(curve, given.noise.curve, given.noise.reference_frames)
        return repeated_reference(counts, given.reference.mean) | linearity_quality(curve, "frame") | judged | alike

    def sample_of(self, registered: Displacement, known: AssumedSample | None = None) -> AssumedSample:
        """Return the `known` sample unless displacements contradict it; else search for their own."""
        made = self.reconstructor
        if known is not None and not made.contradicts(made.solve(registered, sample=known)):
            return known
        return made.find_sample(registered)

    def solve(
        self,
        registered: Displacement,
        *,
        sample: AssumedSample | None = None,
        rounds: int = 0,
        seen: Callable[[Round], object] = lambda _: None,
    ) -> tuple[Wavefront, Assumptions]:
        """Solve for displacements, with their own `sample` if None is given.

        The wavefront is refined in at most `rounds`, fewer where it settles; `seen` is called with each.
        """
        sample = self.reconstructor.find_sample(registered) if sample is None else sample
        step = None
        for step in self.refinement.rounds(registered, rounds, sample) if rounds else ():
            seen(step)
        if step is None:
            return self.reconstructor.solve(registered, sample=sample), Assumptions(sample)
        return step.wavefront, Assumptions(sample, RefinementState("applied", 0.0, bias=step.bias.displacement))

    def measure(
        self,
        frame: Frame,
        solve: Solve,
        timings: Timings,
        *,
        start: Displacement | None = None,
        absorbs: bool | None = None,
        previous: Frame | None = None,
    ) -> Measurement:
        """Register, solve and judge a frame, or say why that is impossible.

        `start` is an earlier frame's displacement, `previous` the frame before; by default, the frame shows `absorbs`.
        """
        try:
            with timings.of("register"):
                registered = self.reconstructor.register(frame.pixels, start=start, absorbs=absorbs)
            with timings.of("reconstruct"):
                wavefront, assumed = solve(registered)
                quality = self.quality(frame.pixels, wavefront.displacement) | _beside(previous, frame)
        except ReconstructionError as error:
            return Measurement(frame, None, str(error), calibration=self.calibration)
        return Measurement(
            frame, wavefront, "", calibration=self.calibration, registered=registered, assumed=assumed, quality=quality
        )


@contextmanager
def _refusals() -> Iterator[None]:
    """Turn a `ValueError` into a `ReconstructionError`: the reference does not allow a model."""
    try:
        yield
    except ValueError as error:
        raise ReconstructionError(str(error), image="reference") from error


@kept_while_alive(maxsize=4)  # another setting does not change it
def _shown_lattice(reference: Average, dark: Average | None, sensor: Sensor, full_scale: float) -> Lattice | None:
    try:
        return surveyed(sensor, reference, dark=dark, full_scale=full_scale).lattice
    except ReconstructionError:
        return None


def _beside(previous: Frame | None, frame: Frame) -> Quality:
    """Quality of a frame beside the one before; the camera counts from 0 after a restart."""
    if previous is None or frame.index <= previous.index:
        return Quality()
    return sequence_quality(previous.pixels, frame.pixels, frame.camera_time_s - previous.camera_time_s)


def mask_sentence(reconstructor: Reconstructor, sample: AssumedSample | None = None) -> str:
    """Say which displacements mask or warp leave out, of a `sample` or in general; empty if all are shown."""
    registration, reconstruction = reconstructor.registration, reconstructor.reconstruction
    bias = "displacements count as mean gradients of the wavefront, whose bias the error bars leave out"
    are_spots = registration.method == "centroids"  # which lie where the mean gradient displaces them
    knows_response = reconstruction.response and registration.fits_warps and not registration.rotation
    if reconstruction.method == "modal" and (are_spots or knows_response):
        bias = ""
    spots = method_sentence(reconstructor) if are_spots and sample is None else ""
    return "; ".join(filter(None, [spots, _left_out(reconstructor, sample), bias]))


def method_sentence(reconstructor: Reconstructor) -> str:
    """Say which registration the reference has chosen, and why; empty if the settings name it."""
    return reconstructor.method_reason and f"registration: {reconstructor.method_reason}"


_UNSEEN: dict[str | None, str] = {  # by warps
    "translation": "a translation does not show how wavefronts change",
    "affine": "an affine warp does not show how wavefronts bend",
}


def _left_out(reconstructor: Reconstructor, sample: AssumedSample | None) -> str:
    warp, hidden = reconstructor.registration.warp, reconstructor.hidden
    if warp in _UNSEEN:
        return f"{_UNSEEN[warp]} over the field; the error bars leave that out"
    if warp is None or not hidden:
        return ""
    fields = FIELD_MODES[warp]
    degree = (math.isqrt(8 * fields + 1) - 3) // 2
    count = 2 * fields if reconstructor.registration.rotation else fields + degree + 1  # gradients of a potential
    if reconstructor.reconstruction.method == "zonal":
        source = "are left out, also of the error bars"
    elif sample is None:
        source = "follow from what is assumed of the sample"
    elif sample.ratios:
        source = "follow from the layer" if len(sample.ratios) == 1 else "follow from the layers"
    else:
        source = "follow only from the smoothness assumption (large error bars)"
    return f"the mask shows {count - hidden} of {count} deformations of a {warp} warp; the others {source}"

"""Estimator: everything that turns the frames of one calibration into measurements; and the same for arrays."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.bench.config import Bench
from app.bench.imaging_model import BenchModel
from app.errors import InputError
from app.measurement.averages import Average
from app.measurement.calibration import Calibration, KnownNoise, surveyed
from app.measurement.measurement import Assumptions, Measurement
from app.memory import kept_for_bench
from app.timing import Timings
from drivers.interface import Frame
from reconstruction.arrays import Counts, Mask
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.frame.above_dark import AboveDark
from reconstruction.frame.bad_pixels import find_bad_pixels, repaired
from reconstruction.frame.noise import TransferCurve, image_transfer
from reconstruction.geometry import Lattice, Sensor
from reconstruction.layers.layer_solver import FrameEquations
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.own_methods import NO_OWN, OwnMethods
from reconstruction.pipeline import Reconstructor
from reconstruction.quality.frame_quality import FrameJudge
from reconstruction.quality.reference_quality import linearity_quality, reference_quality, response_quality
from reconstruction.quality.reference_sample import sample_quality
from reconstruction.quality.sequence import repeated_reference, sequence_quality
from reconstruction.quality.verdict import Quality
from reconstruction.refinement import Refinement, Round
from reconstruction.settings import FIELD_MODES
from reconstruction.wavefront import Wavefront

Solve: TypeAlias = Callable[[Displacement], tuple[Wavefront, Assumptions]]


class Estimator:
    """Reconstructor, judge and refinement of one calibration; each is prepared when it is first used.

    Each of them raises a `ReconstructionError` then, if the calibration does not allow it.
    """

    def __init__(self, calibration: Calibration, *, threads: int = 2) -> None:
        """`threads` render the forward model; only a single one repeats it bit by bit."""
        self.calibration, self._threads = calibration, threads

    @cached_property
    def reconstructor(self) -> Reconstructor:
        """Registers frames, finds the sample, and solves."""
        return self.calibration.reconstructor()

    @cached_property
    def judge(self) -> FrameJudge:
        """Judges frames by their displacements; the calibration itself is judged already."""
        made, given = self.reconstructor, self.calibration
        shown = None
        if given.bench.lattice is not None:
            shown = _shown_lattice(given.dark, given.reference, given.bench.sensor, given.full_scale)
        of_reference = reference_quality(
            given.reference.mean,
            sensor=made.sensor,
            lattice=made.lattice,
            shown=shown,
            dark=given.dark_image,
            variance=given.reference.variance,
            noise=made.noise,
            frames=given.reference_frames,
        )
        return FrameJudge(
            made.subimages,
            made.registration,
            sensor=made.sensor,
            field=made.field,
            dark=given.dark_image,
            of_reference=sample_quality(made.subimages)
            | linearity_quality(given.curve, "reference")
            | of_reference
            | response_quality(made.response_problem),  # named first
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

    def measure(
        self,
        frame: Frame,
        solve: Solve,
        timings: Timings,
        *,
        start: Displacement | None = None,
        previous: Frame | None = None,
    ) -> Measurement:
        """Register, solve and judge a frame, or say why that is impossible.

        `start` is the displacement of an earlier frame, `previous` the frame before this one.
        """
        try:
            with timings.of("register"):
                registered = self.reconstructor.register(frame.pixels, start=start)
            with timings.of("reconstruct"):
                wavefront, assumed = solve(registered)
                quality = self.judge(frame.pixels, wavefront.displacement) | _beside(previous, frame)
        except ReconstructionError as error:
            return Measurement(frame, None, str(error), calibration=self.calibration, start=start)
        return Measurement(
            frame,
            wavefront,
            "",
            calibration=self.calibration,
            start=start,
            registered=registered,
            assumed=assumed,
            quality=quality,
        )


@contextmanager
def _refusals() -> Iterator[None]:
    """Turn a `ValueError` into a `ReconstructionError`: the reference does not allow a model."""
    try:
        yield
    except ValueError as error:
        raise ReconstructionError(str(error), image="reference") from error


@kept_for_bench(maxsize=4)  # another setting does not change it
def _shown_lattice(dark: Average | None, reference: Average, sensor: Sensor, full_scale: float) -> Lattice | None:
    """The lattice that the reference shows; None if it shows none."""
    try:
        return surveyed(sensor, dark, reference, full_scale).lattice
    except ReconstructionError:
        return None


def _beside(previous: Frame | None, frame: Frame) -> Quality:
    """Quality of a frame beside the one before; the camera counts from 0 after a restart."""
    if previous is None or frame.index <= previous.index:
        return Quality()
    return sequence_quality(previous.pixels, frame.pixels, frame.camera_time_s - previous.camera_time_s)


def mask_sentence(reconstructor: Reconstructor, sample: AssumedSample | None = None) -> str:
    """Say which displacements mask or warp leave out, and what they follow from; empty if all are shown.

    Also say if the bias of mean gradients is left out. Without a `sample`, of frames in general.
    """
    return "; ".join(filter(None, [_left_out(reconstructor, sample), _bias(reconstructor)]))


def _bias(reconstructor: Reconstructor) -> str:
    registration, reconstruction = reconstructor.registration, reconstructor.reconstruction
    knows_response = reconstruction.response and registration.method == "gauss_newton" and not registration.rotation
    if reconstruction.method == "modal" and knows_response:
        return ""
    return "displacements count as mean gradients of the wavefront, whose bias the error bars leave out"


def _left_out(reconstructor: Reconstructor, sample: AssumedSample | None) -> str:
    warp, hidden = reconstructor.registration.warp, reconstructor.hidden
    if warp == "affine":
        return "an affine warp does not show how wavefronts bend over the field; the error bars leave that out"
    if warp is None or not hidden:
        return ""
    fields = FIELD_MODES[warp]
    degree = (math.isqrt(8 * fields + 1) - 3) // 2
    count = 2 * fields if reconstructor.registration.rotation else fields + degree + 1  # gradients of a potential
    if reconstructor.reconstruction.method == "zonal":
        source = "are left out, also of the error bars"
    elif sample is None:
        source = "follow from layers, or only from the prior"
    elif sample.ratios:
        source = "follow from the layer" if len(sample.ratios) == 1 else "follow from the layers"
    else:
        source = "are known only by the prior"
    return f"the mask shows {count - hidden} of {count} displacements of a {warp} warp; the others {source}"


class BenchReconstructor:
    """Turns frames of one bench, which are arrays, into wavefronts; what depends on the reference is prepared once.

    It is prepared with `frame`, or else with the first frame that is reconstructed.

    Parameters
    ----------
    bench
        The bench. Without a lattice of its own, the lattice is found in the reference.
    reference
        Frame without the sample, (row, column), counts.
    dark
        Frame without light, (row, column), counts. Without one, the darkest percent of each image is the background.
    full_scale
        Count at which a pixel saturates, infinite if none does; by default see `full_scale_of`.
    frame
        Frame with the sample, (row, column), counts, which with the reference shows the camera's noise.
    own
        Methods that replace those of the bench.

    Raises
    ------
    ReconstructionError
        If the reference shows no lattice, or when it is prepared, cannot be used; the message says why.
    InputError
        If the full scale is not positive.
    """

    def __init__(
        self,
        bench: Bench,
        reference: Counts,
        *,
        dark: Counts | None = None,
        full_scale: float | None = None,
        frame: Counts | None = None,
        own: OwnMethods = NO_OWN,
    ) -> None:
        reference, dark = as_image(reference, "reference"), None if dark is None else as_image(dark, "dark")
        most = full_scale_of(reference, bench.camera_model.bits) if full_scale is None else full_scale
        if not (isinstance(most, float | int | np.number) and most > 0):
            raise InputError(f"full_scale = {full_scale!r}: give the count at which a pixel saturates, as 4095")
        averages = None if dark is None else Average.of_image(dark), Average.of_image(reference)
        registration, reconstruction = own.named(bench.registration, bench.reconstruction)
        named = replace(bench, registration=registration, reconstruction=reconstruction)
        self._calibration = replace(Calibration.of(named, *averages, most), own=own)
        self._is_scale_given = full_scale is not None
        self._estimator: Estimator | None = None
        self.bench = replace(named, lattice=self._calibration.lattice)
        if frame is not None:
            self._prepared(as_image(frame, "frame"))

    def __call__(self, frame: Counts) -> Wavefront:
        """Return the wavefront of a frame (row, column), counts; `ReconstructionError` says why there is none."""
        image = as_image(frame, "frame")
        return self._prepared(image).reconstructor(image)

    def quality(self, frame: Counts, wavefront: Wavefront) -> Quality:
        """Judge a frame (row, column), counts, by its wavefront."""
        counts = as_image(frame, "frame")
        of_frame = linearity_quality(self._curve(counts), "frame")
        judged = self._prepared().judge(counts, wavefront.displacement)
        return repeated_reference(counts, self._calibration.reference.mean) | of_frame | judged

    def mask_sentence(self, wavefront: Wavefront) -> str:
        """Say which displacements the mask hides, and what they follow from; empty if it shows all."""
        return mask_sentence(self._prepared().reconstructor, wavefront.sample)

    def layers(self, wavefront: Wavefront) -> FrameEquations:
        """Normal equations of a wavefront's displacements for layers at any distance."""
        return self._prepared().reconstructor.layers(wavefront.displacement)

    def rounds(self, frame: Counts, most: int) -> Iterator[Round]:
        """Refine the wavefront of a frame (row, column), counts, in at most `most` rounds; fewer where it settles."""
        if whole_number(most, "rounds") < 0:
            raise InputError(f"{most} rounds of refinement are impossible: give 0 or more")
        image = as_image(frame, "frame")
        estimator = self._prepared(image)
        displacement = estimator.reconstructor.register(image)
        return estimator.refinement.rounds(displacement, most, estimator.reconstructor.find_sample(displacement))

    def _prepared(self, frame: Counts | None = None) -> Estimator:
        """The estimator; prepared with the noise that a frame shows, if this is the first call."""
        if self._estimator is None:
            given = self._calibration
            known, full_scale = KnownNoise(None, curve=self._curve(given.reference.mean)), given.full_scale
            if frame is not None:
                AboveDark(given.reference.mean.shape, None, np.inf)(frame, "frame")  # refuses one of another size
                known = _known_noise(self._curve(frame), known.curve)
                if not self._is_scale_given:
                    full_scale = min(full_scale, full_scale_of(frame, self.bench.camera_model.bits))
            estimator = Estimator(replace(given, known=known, full_scale=full_scale))
            _ = estimator.reconstructor  # may refuse
            self._estimator = estimator
        return self._estimator

    def _curve(self, image: Counts) -> TransferCurve | None:
        """Variance of a single image's pixels against their light; None if it does not show them."""
        dark, bad = self._dark_of(image), self._bad
        light = np.subtract(image, np.min(image) if dark is None else dark, dtype=np.float32)
        return image_transfer(repaired(light, bad) if light.shape == bad.shape else light, self.bench.sensor.blur_px)

    @cached_property
    def _bad(self) -> Mask:
        reference = self._calibration.reference.mean
        return find_bad_pixels(reference, self._dark_of(reference))

    def _dark_of(self, image: Counts) -> Counts | None:
        """The dark, unless it has another size, which is refused later."""
        dark = self._calibration.dark_image
        return None if dark is None or dark.shape != image.shape else dark


def _known_noise(frame: TransferCurve | None, reference: TransferCurve | None) -> KnownNoise:
    """Noise of a frame, if it can be seen, and the number of frames averaged in the reference.

    Filtering or a gamma can hide the noise of a frame; then it is that of the reference.
    """
    of_frame, of_reference = (None if curve is None else curve.noise for curve in (frame, reference))
    if of_frame is None or of_reference is None:
        return KnownNoise(of_frame or of_reference, math.inf if of_frame else 1.0, reference)
    averaged = of_frame.counts_per_electron / of_reference.counts_per_electron
    return KnownNoise(of_frame, max(averaged, 1.0), reference)


def as_image(image: ArrayLike, what: str) -> Counts:
    """Return an image (row, column), counts, as an array; `ReconstructionError` if it is none."""
    if isinstance(image, np.ma.MaskedArray):
        raise ReconstructionError(f"the {what} is a masked array: fill the masked pixels first", image=what)
    array = np.asarray(image)
    if array.ndim != 2 or not array.size or array.dtype.kind not in "uif":
        size = " x ".join(map(str, array.shape)) or "a single number"
        raise ReconstructionError(
            f"the {what} must be an array (row, column) of counts: this is {size}, {array.dtype}", image=what
        )
    with np.errstate(over="ignore"):
        if array.dtype.kind == "f" and not np.isfinite(array.astype(np.float32)).all():
            raise ReconstructionError(f"the {what} holds values that are not finite", image=what)
    return cast("Counts", array)


def whole_number(value: object, what: str) -> int:
    """Return an integer of any type as int; `InputError` if it is none."""
    try:
        return operator.index(value)  # type: ignore[arg-type] # refused below
    except TypeError as error:
        raise InputError(f"{what} must be a whole number, not {value!r}") from error


def full_scale_of(image: NDArray[Any], bits: int) -> float:
    """Saturation level: the lower maximum of camera and integer type; infinite for floats beyond the camera's range."""
    camera = 2.0**bits - 1
    if image.dtype.kind in "ui":
        return min(camera, float(np.iinfo(image.dtype).max))
    return camera if not image.size or np.max(image) <= camera else np.inf

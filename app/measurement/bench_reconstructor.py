"""Reconstruction of frames that are arrays, with refinement by the bench's forward model."""

import operator
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.bench.config import Bench
from app.bench.imaging_model import BenchModel
from app.errors import InputError
from app.measurement.assumptions import mask_sentence
from app.measurement.judging import frame_judge
from reconstruction.arrays import Counts, Mask
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise, TransferCurve, image_transfer
from reconstruction.frame.pixels import AboveDark, find_bad_pixels, repaired
from reconstruction.lattice.search import survey
from reconstruction.layers.layer_solver import FrameEquations
from reconstruction.pipeline import NO_OWN, OwnMethods, Reconstructor
from reconstruction.quality.frame_quality import FrameJudge
from reconstruction.quality.reference_quality import linearity_quality
from reconstruction.quality.verdict import Quality, repeated_reference
from reconstruction.refinement import Refinement, Round
from reconstruction.wavefront import Wavefront


class BenchReconstructor:
    """Turns frames of one bench into wavefronts; everything that depends on the reference is prepared once.

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
        lattice = bench.lattice or survey(reference, bench.sensor, dark=dark, full_scale=most).lattice
        self._reference, self._dark, self._full_scale = reference, dark, most
        self._is_lattice_given, self._is_scale_given = bench.lattice is not None, full_scale is not None
        registration, reconstruction = own.named(bench.registration, bench.reconstruction)
        self.bench = replace(bench, lattice=lattice, registration=registration, reconstruction=reconstruction)
        self._own, self._lattice = own, lattice
        self._prepared: Reconstructor | None = None
        if frame is not None:
            self._reconstructor(as_image(frame, "frame"))

    def __call__(self, frame: Counts) -> Wavefront:
        """Return the wavefront of a frame (row, column), counts; `ReconstructionError` says why there is none."""
        image = as_image(frame, "frame")
        return self._reconstructor(image)(image)

    def quality(self, frame: Counts, wavefront: Wavefront) -> Quality:
        """Judge a frame (row, column), counts, by its wavefront."""
        counts = as_image(frame, "frame")
        of_frame = linearity_quality(self._transfer(counts), "frame")
        return repeated_reference(counts, self._reference) | of_frame | self._judge(counts, wavefront.displacement)

    def mask_sentence(self, wavefront: Wavefront) -> str:
        """Say which displacements the mask hides, and what they follow from; empty if it shows all."""
        return mask_sentence(self._reconstructor(), wavefront.sample)

    def layers(self, wavefront: Wavefront) -> FrameEquations:
        """Normal equations of a wavefront's displacements for layers at any distance."""
        return self._reconstructor().layers(wavefront.displacement)

    def rounds(self, frame: Counts, most: int) -> Iterator[Round]:
        """Refine the wavefront of a frame (row, column), counts, in at most `most` rounds; fewer where it settles."""
        if whole_number(most, "rounds") < 0:
            raise InputError(f"{most} rounds of refinement are impossible: give 0 or more")
        image = as_image(frame, "frame")
        reconstructor = self._reconstructor(image)
        displacement = reconstructor.register(image)
        return self._refinement.rounds(displacement, most, reconstructor.find_sample(displacement))

    def _reconstructor(self, frame: Counts | None = None) -> Reconstructor:
        """The reconstructor; prepared with the noise that a frame shows, if this is the first call."""
        if self._prepared is None:
            bench, noise, frames = self.bench, None, np.inf
            if frame is not None:
                AboveDark(self._reference.shape, None, np.inf)(frame, "frame")  # refuses one of another size
                noise, frames = _noise(self._transfer(frame), self._transfer(self._reference))
                if not self._is_scale_given:
                    self._full_scale = min(self._full_scale, full_scale_of(frame, bench.camera_model.bits))
            self._prepared = bench.reconstructor(
                self._reference,
                lattice=self._lattice,
                dark=self._dark,
                full_scale=self._full_scale,
                noise=noise,
                reference_frames=frames,
                own=self._own,
            )
        return self._prepared

    @cached_property
    def _judge(self) -> FrameJudge:
        shown, sensor = None, self.bench.sensor
        if self._is_lattice_given:
            with suppress(ReconstructionError):  # a few lit lenslets show no lattice
                shown = survey(self._reference, sensor, dark=self._dark, full_scale=self._full_scale).lattice
        reconstructor = self._reconstructor()
        return frame_judge(
            reconstructor,
            self._reference,
            shown=shown,
            dark=self._dark,
            frames=reconstructor.subimages.reference_frames,
            curve=self._transfer(self._reference),
        )

    def _transfer(self, image: Counts) -> TransferCurve | None:
        """Variance of an image's pixels against their light; None if it does not show them."""
        dark, bad = self._dark_of(image), self._bad
        light = np.subtract(image, np.min(image) if dark is None else dark, dtype=np.float32)
        return image_transfer(repaired(light, bad) if light.shape == bad.shape else light, self.bench.sensor.blur_px)

    @cached_property
    def _bad(self) -> Mask:
        return find_bad_pixels(self._reference, self._dark_of(self._reference))

    def _dark_of(self, image: Counts) -> Counts | None:
        """The dark, unless it has another size, which is refused later."""
        return self._dark if self._dark is not None and self._dark.shape == image.shape else None

    @cached_property
    def _refinement(self) -> Refinement:
        try:
            return Refinement(self._reconstructor(), BenchModel(self.bench, self._reconstructor()))
        except ValueError as error:  # the reference does not allow a model
            raise ReconstructionError(str(error), image="reference") from error


def _noise(frame: TransferCurve | None, reference: TransferCurve | None) -> tuple[CameraNoise | None, float]:
    """Noise of a frame, None if it cannot be seen, and the number of frames averaged in the reference.

    Filtering or a gamma can hide the noise of a frame; then it is that of the reference.
    """
    of_frame, of_reference = (None if curve is None else curve.noise for curve in (frame, reference))
    if of_frame is None or of_reference is None:
        return of_frame or of_reference, np.inf if of_frame else 1.0
    return of_frame, max(of_frame.counts_per_electron / of_reference.counts_per_electron, 1.0)


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

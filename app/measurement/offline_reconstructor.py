"""Reconstruction and refinement of frames that are arrays, for Python and files."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.bench.config import Bench, as_bench
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.measurement.estimator import ROUNDS, Estimator
from reconstruction.arrays import Counts
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import KnownNoise, TransferCurve
from reconstruction.frame.pixels import DarkSubtractor, KnownCamera
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import survey
from reconstruction.layers.layer_solver import FrameEquations
from reconstruction.quality.verdict import Quality
from reconstruction.reconstructor import NO_OWN, OwnBasis, OwnMethods, OwnRegistration
from reconstruction.refinement import Round
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.wavefront import Wavefront


def reconstructor(
    bench: Bench,
    reference: Counts,
    *,
    dark: Counts | None = None,
    full_scale: float | None = None,
    frame: Counts | None = None,
    registration: OwnRegistration | None = None,
    basis: OwnBasis | None = None,
) -> OfflineReconstructor:
    """Prepare the reconstruction of frames against a reference.

    The camera's noise, which weights lenslets and gives error bars, is estimated from reference and `frame`. Without
    `frame`, it is estimated when the first frame is reconstructed, as `svwfs reconstruct` does.

    Parameters
    ----------
    bench
        The bench. Without a `[lattice]`, the lattice is found in the reference.
    reference
        Frame without the sample, (row, column), counts.
    dark
        Frame without light, (row, column), counts. Without one, the darkest percent of each image is the background.
    full_scale
        Count at which a pixel saturates, such as 4095 for a 12-bit camera, infinite if none does; by default that of 16
        bits.
    frame
        Frame with the sample, (row, column), counts, that shows the camera's noise.
    registration
        Your registration method instead of the bench's: called with the subimages of a reference and the field, it
        returns a `RegistrationMethod` (docs/extending.md).
    basis
        Your pupil modes instead of the bench's: called with the sensor and their number or None, it returns
        `PupilModes` (docs/extending.md).

    Returns
    -------
    OfflineReconstructor
        Call it with a frame (row, column) to get its `Wavefront`: `.views` in rad (view_row, view_column, lenslet_row,
        lenslet_column), `.at(x_m, y_m)` for numbers or arrays, `.sigma()`, `.coefficients`, `.displacement`.

    Raises
    ------
    ReconstructionError
        If reference, dark and bench do not go together, at the latest with the first frame; the message says why.
    InputError
        If the full scale is not positive.

    Examples
    --------
    >>> reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    >>> wavefront = reconstruct(images.frames[0])
    >>> bool(abs(wavefront.views - images.truth).mean() < 0.1)  # rad
    True
    """
    own = OwnMethods(registration, basis)
    made = OfflineReconstructor(as_bench(bench), reference, dark=dark, full_scale=full_scale, own=own)
    if frame is not None:
        made.prepare(frame)
    return made


def refine(reconstructor: OfflineReconstructor, frame: Counts, rounds: int = ROUNDS) -> Wavefront:
    """Reconstruct a frame and remove the estimator's bias with the forward model of the bench.

    Parameters
    ----------
    reconstructor
        Result of `svwfs.reconstructor`; it keeps the model for the next frame.
    frame
        Frame with the sample, (row, column), counts.
    rounds
        Rounds of refinement at most, 0 or more; it ends early when a round no longer improves.

    Returns
    -------
    Wavefront
        The refined wavefront.

    Raises
    ------
    ReconstructionError
        If the frame cannot be reconstructed; the message says why.

    Examples
    --------
    >>> wavefront = svwfs.refine(reconstruct, images.frames[0])
    >>> bool(abs(wavefront.views - images.truth).mean() < 0.05)  # rad
    True
    """
    if whole_number(rounds, "rounds") < 0:
        raise InputError(f"{rounds} rounds of refinement are impossible: give 0 or more")
    return reconstructor.refined(frame, rounds)


def find_lattice(reference: Counts, bench: Bench, *, dark: Counts | None = None) -> Lattice:
    """Find the lenslets on a reference.

    Parameters
    ----------
    reference
        Frame without the sample, (row, column), counts.
    bench
        The bench; its `[sensor]` gives the designed pitch and the rows and columns, unless they are to be found:
        `svwfs.reconstructor(bench, reference).bench` has all of them.
    dark
        Frame without light, (row, column), counts.

    Returns
    -------
    Lattice
        Centre and pitch in px, rotation in rad.

    Raises
    ------
    ReconstructionError
        If the frame shows no such lattice; the message says why.

    Examples
    --------
    >>> round(svwfs.find_lattice(images.reference, bench).pitch_px, 2)
    31.25
    """
    background = None if dark is None else as_image(dark, "dark")
    return survey(as_image(reference, "reference"), as_bench(bench).sensor, dark=background).lattice


class OfflineReconstructor:
    """Turns frames of one bench into wavefronts; `reconstructor` makes it.

    It is prepared with the first frame that is reconstructed, unless `prepare` was called before.
    """

    __module__ = "svwfs"  # so that another process imports svwfs first, which knows the place of all else

    def __init__(
        self,
        bench: Bench,
        reference: Counts,
        *,
        dark: Counts | None = None,
        full_scale: float | None = None,
        own: OwnMethods = NO_OWN,
    ) -> None:
        """Take reference and dark, (row, column), counts, and the count at which a pixel saturates, if known."""
        reference, dark = as_image(reference, "reference"), None if dark is None else as_image(dark, "dark")
        most = full_scale_of(reference, bench.camera_model.bits) if full_scale is None else full_scale
        if not (isinstance(most, float | int | np.number) and most > 0):
            raise InputError(f"full_scale = {full_scale!r}: give the count at which a pixel saturates, as 4095")
        registration, reconstruction = own.named(bench.registration, bench.reconstruction)
        named = replace(bench, registration=registration, reconstruction=reconstruction)
        given = Calibration.of_images(named, reference, dark=dark, full_scale=most)
        self._calibration = replace(given, own=own)
        self._is_scale_given = full_scale is not None
        self._estimator: Estimator | None = None
        self.bench = replace(given.bench, lattice=given.lattice)

    def prepare(self, frame: Counts) -> None:
        """Prepare everything with the noise that a frame (row, column), counts, shows."""
        self.estimator(as_image(frame, "frame"))

    def __call__(self, frame: Counts) -> Wavefront:
        """Return the wavefront of a frame (row, column), counts; `ReconstructionError` says why there is none."""
        return self.refined(frame, 0)

    def refined(self, frame: Counts, rounds: int, *, seen: Callable[[Round], object] = lambda _: None) -> Wavefront:
        """Refine the wavefront of a frame (row, column), counts; see `Estimator.solve`."""
        image = as_image(frame, "frame")
        estimator = self.estimator(image)
        with one_blas_thread():
            return estimator.solve(estimator.reconstructor.register(image), rounds=rounds, seen=seen)[0]

    def quality(self, frame: Counts, wavefront: Wavefront) -> Quality:
        """Judge a frame (row, column), counts, by its wavefront."""
        return self.estimator().quality(as_image(frame, "frame"), wavefront.displacement)

    def layers(self, wavefront: Wavefront) -> FrameEquations:
        """Normal equations of a wavefront's displacements for layers at any distance."""
        return self.estimator().reconstructor.layers(wavefront.displacement)

    def estimator(self, frame: Counts | None = None) -> Estimator:
        """Return the estimator, prepared by the first call with the noise that a frame (row, column), counts, shows."""
        if self._estimator is None:
            given = self._calibration
            known, full_scale = KnownNoise(curve=given.transfer_of(given.reference.mean)), given.full_scale
            if frame is not None:
                DarkSubtractor(given.reference.mean.shape, KnownCamera())(frame, "frame")  # refuses one of another size
                known = _known_noise(given.transfer_of(frame), known.curve)
                if not self._is_scale_given:
                    full_scale = min(full_scale, full_scale_of(frame, self.bench.camera_model.bits))
            estimator = Estimator(replace(given, known=known, full_scale=full_scale))
            _ = estimator.reconstructor  # may refuse
            self._estimator = estimator
        return self._estimator


def _known_noise(frame: TransferCurve | None, reference: TransferCurve | None) -> KnownNoise:
    """Noise of a frame, or of the reference where a filter hides it, and the number of frames averaged in that."""
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
    """Saturation level of an image (row, column), counts: the lower of camera and type; infinite for larger floats."""
    camera = 2.0**bits - 1
    if image.dtype.kind in "ui":
        return min(camera, float(np.iinfo(image.dtype).max))
    return camera if not image.size or np.max(image) <= camera else np.inf

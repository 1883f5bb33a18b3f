"""Registration by SimpleITK: the paper's affine map of each subimage.

The affine map has the settings of MATLAB's imregtform, which is ITK's framework (Mattes et al. 2003; Lowekamp et al.
2013, Frontiers in Neuroinformatics 7, 45): mean squares, regular-step gradient descent, three resolution levels.
It does not conserve flux.

SimpleITK is optional and registers one pair of images per call. Its calls release Python's lock, so that threads share
the lenslets.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Booleans, Floats, Image
from reconstruction.displacement import Displacement, LensletStatus, RegistrationMethod
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.registration.gauss_newton import SteepestDescent, coefficient_covariance, prepare_template
from reconstruction.registration.subimages import MISFIT, LensletModel, ReferenceSubimages, classify_lenslets
from reconstruction.runtime.threads import THREADS, in_threads
from reconstruction.settings import RegistrationSettings

# MATLAB's registration.optimizer.RegularStepGradientDescent of imregconfig("monomodal")
_MAXIMUM_STEP = 0.0625
_MINIMUM_STEP = 1e-5
_ITERATIONS = 100  # at each level
_RELAXATION = 0.5
_GRADIENT_TOLERANCE = 1e-4
_SHRINK = (4, 2, 1)  # imregtform's three pyramid levels
_SMOOTHING_PX = (2.0, 1.0, 0.0)
_BRIGHTEST = 255.0  # grey value of the reference's brightest pixel, the unit of the gradient tolerance


def prepare(
    reference: ReferenceSubimages, _settings: RegistrationSettings, _field: Field, _model: LensletModel | None
) -> RegistrationMethod:
    """Prepare the method `itk_affine`."""
    return ItkAffine(reference)


class ItkAffine:
    """The paper's registration: an affine map of each subimage."""

    def __init__(self, reference: ReferenceSubimages) -> None:
        """Prepare for one reference; raise `ReconstructionError` if SimpleITK is not installed."""
        self._itk = load_simple_itk()
        self._reference, self._modes = reference, LegendreModes(3)
        self._scale = _BRIGHTEST / reference.light[reference.lit].max()
        windows = reference.light.reshape(-1, reference.width, reference.width)
        self._windows = (windows * self._scale).astype(np.float32)
        every = np.ones((reference.width, reference.width), np.bool_)
        basis = np.eye(2 * self._modes.count)
        template = prepare_template(SteepestDescent(reference, self._modes, every, basis, conserve_flux=False))
        self._covariance = coefficient_covariance(template.per_pixel.covariance, basis)

    def __call__(self, light: Image, *, saturated: Booleans, start: Displacement | None = None) -> Displacement:  # noqa: ARG002 - each frame is searched anew
        """Register a frame; see `displacement.RegistrationMethod`."""
        reference = self._reference
        subimages = reference.cut(light)
        scaled = (subimages * self._scale).astype(np.float32)
        coefficients = map_lenslets(self._align, self._windows, scaled, (2, self._modes.count))
        x, y = reference.offset_px.T / reference.half_width_px
        flow = np.swapaxes(coefficients @ self._modes.values(x, y), 1, 2)
        residual_rms, found = misfit(reference, subimages, flow)
        pixels, parameters = len(x), 2 * self._modes.count + 2
        noise = residual_rms**2 * pixels / (pixels - parameters)
        return classify_lenslets(
            reference,
            self._modes,
            coefficients,
            covariance=self._covariance * noise[:, None, None, None, None],
            residual_rms=residual_rms / reference.contrast.max(),
            contrast=subimages.std(axis=(1, 2)),
            faults={LensletStatus.DIVERGED: ~found, LensletStatus.SATURATED: reference.touched(saturated)},
        )

    def _align(self, reference: Image, subimage: Image) -> Floats | None:
        """Coefficients c_q, px, (xy, Q) of one subimage; None if ITK fails."""
        itk = self._itk
        try:
            affine = align_affine(itk, itk.GetImageFromArray(reference), itk.GetImageFromArray(subimage))
        except RuntimeError:  # SimpleITK's only exception: the images do not overlap
            return None
        matrix = np.reshape(affine.GetMatrix(), (2, 2)) - np.eye(2)
        return np.column_stack([affine.GetTranslation(), matrix * self._reference.half_width_px])


def misfit(reference: ReferenceSubimages, subimages: Floats, flow: Floats) -> tuple[Floats, Booleans]:
    """RMS of I0(x) - gain I1(x + d(x)) - offset over each window, counts, (L,), at its least.

    subimages (L, width, width); flow (L, N, xy), px, NaN where lost, as is the RMS. Also the lenslets that match, (L,).
    """
    lenslets, width = len(subimages), reference.width
    position = flow + reference.offset_px + (width - 1) / 2
    known = np.isfinite(position).all(axis=(1, 2))
    lenslet = np.broadcast_to(np.arange(lenslets)[:, None], position.shape[:2])
    where = np.stack([lenslet, position[..., 1], position[..., 0]])[:, known]
    moved = ndimage.map_coordinates(subimages, where, order=1, mode="nearest")
    still = reference.light[known]
    moved, still = (image - image.mean(axis=1, keepdims=True) for image in (moved, still))
    power = np.sum(moved**2, axis=1)
    gain = np.sum(moved * still, axis=1) / np.where(power > 0, power, 1.0)
    residual_rms = np.full(lenslets, np.nan)
    residual_rms[known] = np.sqrt(np.mean((still - gain[:, None] * moved) ** 2, axis=1))
    return residual_rms, residual_rms < MISFIT * reference.contrast


def align_affine(itk: Any, reference: Any, subimage: Any) -> Any:
    """Affine map between two ITK images, from the reference's position to the subimage's; or RuntimeError."""
    method = mean_squares(itk)
    method.SetOptimizerAsRegularStepGradientDescent(
        learningRate=_MAXIMUM_STEP,
        minStep=_MINIMUM_STEP,
        numberOfIterations=_ITERATIONS,
        relaxationFactor=_RELAXATION,
        gradientMagnitudeTolerance=_GRADIENT_TOLERANCE,
    )
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetShrinkFactorsPerLevel(_SHRINK)
    method.SetSmoothingSigmasPerLevel(_SMOOTHING_PX)
    affine = itk.AffineTransform(2)
    affine.SetCenter([(size - 1) / 2 for size in reference.GetSize()])
    method.SetInitialTransform(affine, True)  # in place
    method.Execute(reference, subimage)
    return affine


def mean_squares(itk: Any) -> Any:
    """Registration by mean squares and linear interpolation, in one thread."""
    method = itk.ImageRegistrationMethod()
    method.SetNumberOfThreads(1)
    method.SetMetricAsMeanSquares()
    method.SetInterpolator(itk.sitkLinear)
    return method


def load_simple_itk() -> Any:
    """Import SimpleITK; raise `ReconstructionError` if it is not installed."""
    try:
        import SimpleITK  # noqa: PLC0415 - an optional extra that takes a second to load
    except ImportError as error:
        raise ReconstructionError("this method needs SimpleITK: pip install 'svwfs[peers]'") from error
    # It warns of each lost lenslet, whose outcome says it.
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)  # type: ignore[no-untyped-call] # it declares no types
    return SimpleITK


def map_lenslets(
    align: Callable[[Image, Image], Floats | None],
    references: Image,
    subimages: Image,
    shape: tuple[int, ...],
    *,
    threads: int = THREADS,
) -> Floats:
    """Align each pair of windows (L, width, width): (L, *shape), NaN where `align` returns None."""
    results = in_threads(lambda pair: align(*pair), zip(references, subimages, strict=True), threads)
    return np.stack([np.full(shape, np.nan) if each is None else each for each in results])

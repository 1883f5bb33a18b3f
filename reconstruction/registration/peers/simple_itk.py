"""Registration by SimpleITK: the paper's affine map, and the non-rigid methods that it names.

The affine map has the settings of MATLAB's imregtform, which is ITK's framework (Mattes et al. 2003; Lowekamp et al.
2013, Frontiers in Neuroinformatics 7, 45): mean squares, regular-step gradient descent, three resolution levels.
Diffeomorphic demons (Vercauteren et al. 2009, NeuroImage 45, S61) push every pixel along the gradient and smooth the
result; free-form deformation (Rueckert et al. 1999, IEEE Trans. Med. Imaging 18, 712) moves the control points of a
cubic B-spline. Both start from the affine map, because nothing shows motion inside a uniform square: from zero they
leave 2 rad of residual, where the affine map leaves 0.4. None of the methods conserves flux.

SimpleITK is optional and registers one pair of images per call. Its calls release Python's lock, so that threads share
the lenslets.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.displacement import Displacement, Outcome
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import FieldModes, LegendreModes
from reconstruction.registration.classification import classify_lenslets
from reconstruction.registration.gauss_newton.template import coefficient_covariance, prepare_template
from reconstruction.registration.peers.flow import FlowToModes, misfit
from reconstruction.registration.subimages import ReferenceSubimages

_THREADS = min(2, os.cpu_count() or 1)

# MATLAB's registration.optimizer.RegularStepGradientDescent of imregconfig("monomodal")
_MAXIMUM_STEP = 0.0625
_MINIMUM_STEP = 1e-5
_ITERATIONS = 100  # at each level
_RELAXATION = 0.5
_GRADIENT_TOLERANCE = 1e-4
_SHRINK = (4, 2, 1)  # imregtform's three pyramid levels
_SMOOTHING_PX = (2.0, 1.0, 0.0)
_BRIGHTEST = 255.0  # grey value of the reference's brightest pixel, the unit of the gradient tolerance

_CONTRAST = 64.0  # standard deviation of the grey values of the non-rigid methods
_DEMONS_SMOOTHING_PX = 2.0  # of the displacement, after each iteration
_DEMONS_ITERATIONS = 20
_DEMONS_SAME = 0.3 * _CONTRAST  # smaller differences of grey values exert no force: they are flux, not motion
_MESH = 2  # elements of the B-spline along x and y; with 4 the inside of a square bends arbitrarily
_FREE_FORM_ITERATIONS = 20
_FREE_FORM_TOLERANCE = 1e-5


class ItkAffine:
    """The paper's registration: an affine map of each subimage."""

    def __init__(self, reference: ReferenceSubimages) -> None:
        """Prepare for one reference; raise `ReconstructionError` if SimpleITK is not installed."""
        self._itk = _load_simple_itk()
        self._reference, self._modes = reference, LegendreModes(3)
        self._scale = _BRIGHTEST / reference.light[reference.lit].max()
        windows = reference.light.reshape(-1, reference.width, reference.width)
        self._windows = (windows * self._scale).astype(np.float32)
        every = np.ones((reference.width, reference.width), np.bool_)
        template = prepare_template(
            reference, self._modes, every, basis=np.eye(2 * self._modes.count), conserve_flux=False
        )
        self._covariance = coefficient_covariance(template.per_pixel.covariance, np.eye(2 * self._modes.count))

    def __call__(self, light: Image, *, saturated: Mask, start: Displacement | None = None) -> Displacement:  # noqa: ARG002 - each frame is searched anew
        """Register a frame; see `displacement.RegistrationMethod`."""
        reference = self._reference
        subimages = reference.cut(light)
        scaled = (subimages * self._scale).astype(np.float32)
        coefficients = _map_lenslets(self._align, self._windows, scaled, (2, self._modes.count))
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
            faults={Outcome.DIVERGED: ~found, Outcome.SATURATED: reference.touched(saturated)},
        )

    def _align(self, reference: Image, subimage: Image) -> Floats | None:
        """Coefficients c_q, px, (xy, Q) of one subimage; None if ITK fails."""
        itk = self._itk
        try:
            affine = _align_affine(itk, itk.GetImageFromArray(reference), itk.GetImageFromArray(subimage))
        except RuntimeError:  # SimpleITK's only exception: the images do not overlap
            return None
        matrix = np.reshape(affine.GetMatrix(), (2, 2)) - np.eye(2)
        return np.column_stack([affine.GetTranslation(), matrix * self._reference.half_width_px])


class _Deformable(ABC):
    """A non-rigid registration of every lenslet's pair of images, scaled to equal brightness."""

    _threads = _THREADS

    def __init__(self, reference: ReferenceSubimages, modes: FieldModes) -> None:
        """Prepare for one reference; raise `ReconstructionError` if SimpleITK is not installed."""
        self._itk = _load_simple_itk()
        self._reference = reference
        self._to_modes = FlowToModes(reference, modes)
        self._windows = _equally_bright(reference.light.reshape(-1, reference.width, reference.width))

    def __call__(self, light: Image, *, saturated: Mask, start: Displacement | None = None) -> Displacement:  # noqa: ARG002 - each frame is searched anew
        """Register a frame; see `displacement.RegistrationMethod`."""
        subimages = self._reference.cut(light)
        shape = (len(self._reference.offset_px), 2)
        flow = _map_lenslets(self._align, self._windows, _equally_bright(subimages), shape, threads=self._threads)
        return self._to_modes(flow, subimages, saturated=saturated)

    def _align(self, reference: Image, subimage: Image) -> Floats | None:
        """Flow of one lenslet, (N, xy), px; None if ITK fails."""
        itk = self._itk
        still, moved = itk.GetImageFromArray(reference), itk.GetImageFromArray(subimage)
        try:
            flow = self._field(still, moved, _align_affine(itk, still, moved))
        except RuntimeError:  # SimpleITK's only exception: the images do not overlap
            return None
        return np.asarray(itk.GetArrayFromImage(flow), np.float64).reshape(-1, 2)

    @abstractmethod
    def _field(self, reference: Any, subimage: Any, start: Any) -> Any:
        """Displacement field of two ITK images, reference(x) ~ subimage(x + d(x)), from the affine map `start`."""


class Demons(_Deformable):
    """Registration by diffeomorphic demons."""

    def _field(self, reference: Any, subimage: Any, start: Any) -> Any:
        itk = self._itk
        field = itk.TransformToDisplacementField(start, itk.sitkVectorFloat64, reference.GetSize())
        demons = itk.DiffeomorphicDemonsRegistrationFilter()
        demons.SetNumberOfThreads(1)
        demons.SetStandardDeviations(_DEMONS_SMOOTHING_PX)
        demons.SetNumberOfIterations(_DEMONS_ITERATIONS)
        demons.SetIntensityDifferenceThreshold(_DEMONS_SAME)
        return demons.Execute(reference, subimage, field)


class FreeForm(_Deformable):
    """Registration by free-form deformation."""

    _threads = 1  # two L-BFGS-B searches at a time can crash the program: "munmap_chunk(): invalid pointer"

    def _field(self, reference: Any, subimage: Any, start: Any) -> Any:
        itk = self._itk
        spline = itk.BSplineTransformInitializer(reference, [_MESH, _MESH], 3)
        method = _mean_squares(itk)
        method.SetOptimizerAsLBFGSB(
            gradientConvergenceTolerance=_FREE_FORM_TOLERANCE, numberOfIterations=_FREE_FORM_ITERATIONS
        )
        method.SetMovingInitialTransform(start)
        method.SetInitialTransform(spline, True)  # in place
        method.Execute(reference, subimage)
        field = itk.TransformToDisplacementFieldFilter()
        field.SetNumberOfThreads(1)
        field.SetReferenceImage(reference)
        return field.Execute(itk.CompositeTransform([start, spline]))


def _align_affine(itk: Any, reference: Any, subimage: Any) -> Any:
    """Affine map between two ITK images, from the reference's position to the subimage's; or RuntimeError."""
    method = _mean_squares(itk)
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


def _mean_squares(itk: Any) -> Any:
    method = itk.ImageRegistrationMethod()
    method.SetNumberOfThreads(1)
    method.SetMetricAsMeanSquares()
    method.SetInterpolator(itk.sitkLinear)
    return method


def _equally_bright(windows: Floats) -> Image:
    """Shift and scale windows (L, width, width) to mean 0 and a fixed standard deviation."""
    mean, contrast = (np.asarray(of(windows, axis=(1, 2), keepdims=True)) for of in (np.mean, np.std))
    return np.asarray(_CONTRAST * (windows - mean) / np.where(contrast > 0, contrast, 1.0), np.float32)


def _load_simple_itk() -> Any:
    try:
        import SimpleITK  # noqa: PLC0415 - an optional extra that takes a second to load
    except ImportError as error:
        raise ReconstructionError("this method needs SimpleITK: pip install 'svwfs[peers]'") from error
    # It warns of each lost lenslet, whose outcome says it.
    SimpleITK.ProcessObject.SetGlobalWarningDisplay(False)  # type: ignore[no-untyped-call] # it declares no types
    return SimpleITK


def _map_lenslets(
    align: Callable[[Image, Image], Floats | None],
    references: Image,
    subimages: Image,
    shape: tuple[int, ...],
    *,
    threads: int = _THREADS,
) -> Floats:
    """Align each pair of windows (L, width, width): (L, *shape), NaN where `align` returns None."""
    with ThreadPoolExecutor(threads, thread_name_prefix="simple-itk") as pool:
        results = list(pool.map(align, references, subimages))
    return np.stack([np.full(shape, np.nan) if each is None else each for each in results])

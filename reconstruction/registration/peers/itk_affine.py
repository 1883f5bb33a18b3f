"""The paper's registration: an affine map by intensity-based optimisation, with the settings of MATLAB's imregtform.

imregtform is ITK's registration framework (Mattes et al. 2003; Lowekamp et al. 2013, Frontiers in Neuroinformatics 7,
45) under MATLAB's default settings: mean squares of the grey values, regular-step gradient descent, three levels of
resolution, linear interpolation. It knows nothing of the flux, and so it is here the baseline.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.displacement import Displacement
from reconstruction.modes.field_modes import LegendreModes
from reconstruction.registration.gauss_newton.template import prepare_template
from reconstruction.registration.peers.flow import displacement_of, misfit
from reconstruction.registration.peers.simple_itk import for_every_lenslet, load_simple_itk
from reconstruction.registration.subimages import ReferenceSubimages

# MATLAB's registration.optimizer.RegularStepGradientDescent, as imregconfig("monomodal") makes it
_MAXIMUM_STEP = 0.0625
_MINIMUM_STEP = 1e-5
_ITERATIONS = 100  # at each level
_RELAXATION = 0.5
_GRADIENT_TOLERANCE = 1e-4
_SHRINK = (4, 2, 1)  # imregtform's three pyramid levels
_SMOOTHING_PX = (2.0, 1.0, 0.0)

_BRIGHTEST = 255.0  # grey value given to the reference's brightest pixel: the gradient's tolerance has that unit


class ItkAffine:
    """Registers frames against one reference by SimpleITK, one lenslet after the other."""

    def __init__(self, reference: ReferenceSubimages) -> None:
        """Prepare for one reference; raise `ReconstructionError` where SimpleITK is not installed."""
        self._itk = load_simple_itk()
        self._reference, self._modes = reference, LegendreModes(3)
        self._scale = _BRIGHTEST / reference.light[reference.lit].max()
        windows = reference.light.reshape(-1, reference.width, reference.width)
        self._windows = (windows * self._scale).astype(np.float32)
        every = np.ones(len(reference.offset_px), np.bool_)
        self._covariance = prepare_template(reference, self._modes, every, conserve_flux=False).per_pixel.covariance

    def __call__(self, light: Image, *, saturated: Mask, start: Displacement | None = None) -> Displacement:  # noqa: ARG002 - each frame is searched anew
        """Compare a frame with the reference; see `displacement.RegistrationMethod`."""
        reference = self._reference
        subimages = reference.cut(light)
        scaled = (subimages * self._scale).astype(np.float32)
        coefficients = for_every_lenslet(self._align, self._windows, scaled, (2, self._modes.count))
        x, y = reference.offset_px.T / reference.half_width_px
        flow = np.swapaxes(coefficients @ self._modes.values(x, y), 1, 2)
        residual_rms = misfit(reference, subimages, flow)
        pixels, parameters = len(x), 2 * self._modes.count + 2
        noise = residual_rms**2 * pixels / (pixels - parameters)
        return displacement_of(
            reference,
            self._modes,
            coefficients,
            covariance=self._covariance * noise[:, None, None, None, None],
            residual_rms=residual_rms,
            contrast=subimages.std(axis=(1, 2)),
            saturated=saturated,
        )

    def _align(self, reference: Image, subimage: Image) -> Floats | None:
        """Align one subimage: coefficients c_q, px, (xy, Q); None where ITK gives up."""
        itk = self._itk
        try:
            affine = align_affine(itk, itk.GetImageFromArray(reference), itk.GetImageFromArray(subimage))
        except RuntimeError:  # no light in common: all that SimpleITK raises when the maps have run apart
            return None
        matrix = np.reshape(affine.GetMatrix(), (2, 2)) - np.eye(2)
        return np.column_stack([affine.GetTranslation(), matrix * self._reference.half_width_px])


def align_affine(itk: Any, reference: Any, subimage: Any) -> Any:
    """Align two images of ITK, grey values about 0 ... 255; raise RuntimeError where they have nothing in common.

    ITK samples the subimage at center + matrix (x - center) + shift: where the reference's light at x arrives.
    """
    method = itk.ImageRegistrationMethod()
    method.SetNumberOfThreads(1)
    method.SetMetricAsMeanSquares()
    method.SetInterpolator(itk.sitkLinear)
    method.SetOptimizerAsRegularStepGradientDescent(
        learningRate=_MAXIMUM_STEP,
        minStep=_MINIMUM_STEP,
        numberOfIterations=_ITERATIONS,
        relaxationFactor=_RELAXATION,
        gradientMagnitudeTolerance=_GRADIENT_TOLERANCE,
    )
    method.SetOptimizerScalesFromPhysicalShift()  # a step moves a pixel alike, by a shift or by a shear
    method.SetShrinkFactorsPerLevel(_SHRINK)
    method.SetSmoothingSigmasPerLevel(_SMOOTHING_PX)
    affine = itk.AffineTransform(2)
    affine.SetCenter([(size - 1) / 2 for size in reference.GetSize()])
    method.SetInitialTransform(affine, True)  # in place
    method.Execute(reference, subimage)
    return affine

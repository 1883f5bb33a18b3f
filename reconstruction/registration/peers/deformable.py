"""Non-rigid registration by SimpleITK: the methods that the paper names for what an affine map cannot follow.

Diffeomorphic demons (Vercauteren et al. 2009, NeuroImage 45, S61) push every pixel along the grey values' gradient and
smooth the result; free-form deformation (Rueckert et al. 1999, IEEE Trans. Med. Imaging 18, 712; Xie and Farin 2004)
moves the control points of a cubic B-spline. Both minimise the mean square difference of the grey values and know
nothing of the flux: where the light is spread thinner, they see a darker image and no displacement explains it.

Both begin at the affine map. Inside a uniform square nothing says how the light has moved: begun at no displacement,
they leave the middle of the field where it was (2 rad of residual where the affine map leaves 0.4).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from reconstruction.arrays import Floats, Image, Mask
from reconstruction.displacement import Displacement
from reconstruction.modes.field_modes import FieldModes
from reconstruction.registration.peers.flow import FlowReading
from reconstruction.registration.peers.itk_affine import align_affine
from reconstruction.registration.peers.simple_itk import THREADS, for_every_lenslet, load_simple_itk
from reconstruction.registration.subimages import ReferenceSubimages

_CONTRAST = 64.0  # standard deviation of the grey values that ITK is given

_DEMONS_SMOOTHING_PX = 2.0  # of the displacement, after each iteration
_DEMONS_ITERATIONS = 20
_DEMONS_SAME = 0.3 * _CONTRAST  # grey values that differ by less push nothing: it is the light that is thinner there

_MESH = 2  # elements of the B-spline along x and along y; with 4, the square's inside bends at will
_FREE_FORM_ITERATIONS = 20
_GRADIENT_TOLERANCE = 1e-5


class _Deformable(ABC):
    """Gives every lenslet's pair of images, equally bright, to one of ITK's registrations."""

    _threads = THREADS

    def __init__(self, reference: ReferenceSubimages, modes: FieldModes) -> None:
        """Prepare for one reference, displacements written in `modes` (see `flow.FlowReading`).

        Raises `ReconstructionError` where SimpleITK is not installed.
        """
        self._itk = load_simple_itk()
        self._reference = reference
        self._read = FlowReading(reference, modes)
        self._windows = _equally_bright(reference.light.reshape(-1, reference.width, reference.width))

    def __call__(self, light: Image, *, saturated: Mask, start: Displacement | None = None) -> Displacement:  # noqa: ARG002 - each frame is searched anew
        """Compare a frame with the reference; see `displacement.RegistrationMethod`."""
        subimages = self._reference.cut(light)
        shape = (len(self._reference.offset_px), 2)
        flow = for_every_lenslet(self._align, self._windows, _equally_bright(subimages), shape, threads=self._threads)
        return self._read(flow, subimages, saturated=saturated)

    def _align(self, reference: Image, subimage: Image) -> Floats | None:
        """Find the flow of one lenslet, (N, xy), px; None where ITK gives up."""
        itk = self._itk
        still, moved = itk.GetImageFromArray(reference), itk.GetImageFromArray(subimage)
        try:
            flow = self._field(still, moved, align_affine(itk, still, moved))
        except RuntimeError:  # all that SimpleITK raises, when no light of the two meets
            return None
        return np.asarray(itk.GetArrayFromImage(flow), np.float64).reshape(-1, 2)

    @abstractmethod
    def _field(self, reference: Any, subimage: Any, start: Any) -> Any:
        """Return the displacement field of two ITK images as a third: reference(x) ~ subimage(x + d(x)).

        `start` is the affine map between them.
        """


class Demons(_Deformable):
    """Registers frames against one reference by diffeomorphic demons."""

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
    """Registers frames against one reference by free-form deformation."""

    _threads = 1  # two L-BFGS-B searches at a time were seen to end the program: "munmap_chunk(): invalid pointer"

    def _field(self, reference: Any, subimage: Any, start: Any) -> Any:
        itk = self._itk
        spline = itk.BSplineTransformInitializer(reference, [_MESH, _MESH], 3)
        method = itk.ImageRegistrationMethod()
        method.SetNumberOfThreads(1)
        method.SetMetricAsMeanSquares()
        method.SetInterpolator(itk.sitkLinear)
        method.SetOptimizerAsLBFGSB(
            gradientConvergenceTolerance=_GRADIENT_TOLERANCE, numberOfIterations=_FREE_FORM_ITERATIONS
        )
        method.SetMovingInitialTransform(start)
        method.SetInitialTransform(spline, True)  # in place
        method.Execute(reference, subimage)
        field = itk.TransformToDisplacementFieldFilter()
        field.SetNumberOfThreads(1)
        field.SetReferenceImage(reference)
        return field.Execute(itk.CompositeTransform([start, spline]))


def _equally_bright(windows: Floats) -> Image:
    """Shift and scale windows (L, width, width) to mean 0 and one standard deviation: no gain, no background."""
    mean, contrast = (np.asarray(of(windows, axis=(1, 2), keepdims=True)) for of in (np.mean, np.std))
    return np.asarray(_CONTRAST * (windows - mean) / np.where(contrast > 0, contrast, 1.0), np.float32)

"""Brightness of the points of the source, estimated from the reference."""

import numpy as np
from scipy.optimize import nnls

from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.registration.subimages import ReferenceSubimages

# SciPy's default of 3 is too small, e.g. if the lattice's rotation is off by a pixel at the edge.
_ITERATIONS_PER_POINT = 30


def mean_subimage(reference: ReferenceSubimages) -> tuple[Floats, Floats]:
    """Mean subimage of the lit lenslets, of unit sum, (width, width), and the light of each lenslet, counts.

    The light is (lenslet_row, lenslet_column); 0 where the lenslet is dark.
    """
    light = np.where(reference.lit, np.sum(reference.light, axis=1), 0.0)
    light = np.maximum(light, 0.0)
    mean = np.sum(reference.light[reference.lit], axis=0) / np.sum(light)
    return mean.reshape(reference.width, reference.width), light.reshape(reference.lenslets)


def point_brightness(point_images: Image, subimage: Floats) -> Floats:
    """Non-negative brightness (point,) whose point images (point, row, column) add up to a subimage."""
    matrix = point_images.reshape(len(point_images), -1).T.astype(np.float64)
    scale = np.max(matrix)  # the solver's tolerance is absolute
    try:
        found, _ = nnls(matrix / scale, subimage.ravel(), maxiter=_ITERATIONS_PER_POINT * len(point_images))
    except RuntimeError as error:  # SciPy did not converge
        raise ReconstructionError("the source's shape cannot be found in the reference: is it in focus?") from error
    return np.asarray(found / scale)

"""Find frames displaced by whole lenslets: each spot lies in the cell of another lenslet, where it seems undisplaced.

The edge of the light and the shadow inside it tell: the lit cells of the frame are those of the reference, displaced by
a period of the lattice. A sample that blocks light does not light other cells instead.
"""

import numpy as np
from scipy import spatial

from reconstruction.arrays import Booleans, Counts, Floats
from reconstruction.geometry import lenslet_centers
from reconstruction.registration.subimages import ReferenceSubimages

_RINGS = 2  # of cells around the lattice; even, so that odd rows stay odd
_FARTHEST = 2.5  # pitches, of the periods that are tried
_SAME = 0.1  # pitches between a displaced cell and another one
_LIT = 0.25  # of the contrast of a typical lit cell
FEWEST = 3  # cells that become lit, and that become dark
_UNEXPLAINED = 0.5  # of the cells that differ without a displacement, which may differ with it


class LensletShift:
    """Compares the lit cells of frames with those of one reference."""

    def __init__(self, reference: ReferenceSubimages, dark: Counts | None) -> None:
        rows, columns = (count + 2 * _RINGS for count in reference.lenslets)
        place = lenslet_centers(reference.sensor.arrangement, rows, columns).reshape(-1, 2)  # pitches
        self._px_per_pitch = reference.px_per_pitch
        center_px = reference.center_px[0] + (place - place[_RINGS * columns + _RINGS]) @ self._px_per_pitch
        at_px = center_px[:, None] + reference.offset_px[::2] @ reference.turn
        column, row = np.moveaxis(np.rint(at_px).astype(np.intp), -1, 0)
        height, width = reference.image.shape
        on_camera = np.all((column >= 0) & (row >= 0) & (column < width) & (row < height), axis=1)
        self._place, self._pixel = place[on_camera], (row * width + column)[on_camera]
        self._dark = 0.0 if dark is None else dark.ravel()[self._pixel]
        self._usual = np.count_nonzero(reference.lit)
        self._lit = self._are_lit(reference.image.ravel()[self._pixel])

    def __call__(self, frame: Counts) -> Floats:
        """Displacement of a frame (row, column), counts, by a period of the lattice, px on the camera, (xy,); or 0."""
        lit = self._are_lit(frame.ravel()[self._pixel] - self._dark)
        if min(np.count_nonzero(lit & ~self._lit), np.count_nonzero(self._lit & ~lit)) < FEWEST:
            return np.zeros(2)
        tree = spatial.KDTree(self._place)
        middle = self._place[np.argmin(np.sum((self._place - self._place.mean(axis=0)) ** 2, axis=1))]
        best, explained = np.zeros(2), 0
        for period in self._place[tree.query_ball_point(middle, _FARTHEST)] - middle:
            away, source = map(np.asarray, tree.query(self._place - period))
            known = away < _SAME
            still = int(np.count_nonzero(lit[known] != self._lit[known]))
            displaced = int(np.count_nonzero(lit[known] != self._lit[source[known]]))
            if displaced <= _UNEXPLAINED * still and still - displaced > explained:
                best, explained = period @ self._px_per_pitch, still - displaced
        return np.asarray(best)

    def _are_lit(self, light: Floats) -> Booleans:
        """True for cells with at least a share of the contrast of as many as are lit in the reference, (cell,)."""
        contrast = light.std(axis=1)
        return np.asarray(contrast > _LIT * np.median(np.sort(contrast)[-self._usual :]))

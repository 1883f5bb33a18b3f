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
        on_camera = np.all((at_px > -0.5) & (at_px < np.array(reference.image.shape[::-1]) - 0.5), axis=(1, 2))
        self._place, self._at_px = place[on_camera], at_px[on_camera]
        self._dark, self._usual = dark, np.count_nonzero(reference.lit)
        self._lit = self._are_lit(reference.image, np.zeros(2))

    def __call__(self, frame: Counts, moved_px: Floats) -> Floats:
        """Displacement of a frame (row, column), counts, by a period of the lattice, px on the camera, (xy,); or 0.

        `moved_px` (xy,) is the displacement that was measured, about which cells are looked at.
        """
        lit = self._are_lit(frame if self._dark is None else frame - self._dark, moved_px)
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

    def _are_lit(self, light: Counts, moved_px: Floats) -> Booleans:
        """True for cells with at least a share of the contrast of as many as are lit in the reference, (cell,)."""
        last = np.array(light.shape[::-1]) - 1
        column, row = np.moveaxis(np.rint(self._at_px + moved_px).astype(np.intp).clip(0, last), -1, 0)
        contrast = light[row, column].std(axis=1)
        return np.asarray(contrast > _LIT * np.median(np.sort(contrast)[-self._usual :]))

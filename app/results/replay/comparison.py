"""What another bench makes of recorded frames, beside what was made of them."""

from __future__ import annotations

import numpy as np

from app.recording.reprocess import Reprocessed
from app.results.view_quality import Variable, about
from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.wavefront import Wavefront, rms

_VIEW = ("view_row", "view_column")


class Comparison:
    """Hears of every frame made both ways; all numbers are means over the frames for which there are both."""

    def __init__(self) -> None:
        self.frames = 0
        self.field: Field | None = None
        self._sums: list[Floats] = []

    def take(self, then: Reprocessed, now: Reprocessed) -> dict[str, Variable]:
        """Compare one frame; return what there is to say of it, for its results."""
        if then.wavefront is None or now.wavefront is None or not are_alike(then.wavefront, now.wavefront):
            return {}
        values = [rms(then.wavefront.views), rms(now.wavefront.views), rms(now.wavefront.views - then.wavefront.views)]
        self._sums = [total + value for total, value in zip(self._sums or [np.zeros(1)] * 3, values, strict=True)]
        self.frames, self.field = self.frames + 1, now.wavefront.field
        return {
            "recorded_rms": (_VIEW, values[0], about("rad", "RMS of each view's wavefront with the recorded bench")),
            "difference_rms": (_VIEW, values[2], about("rad", "RMS difference of each view's wavefront from it")),
        }

    @property
    def recorded_rms_rad(self) -> Floats:
        """RMS with the recorded bench, (view_row, view_column)."""
        return self._sums[0] / self.frames

    @property
    def rms_rad(self) -> Floats:
        """RMS with the other bench, (view_row, view_column)."""
        return self._sums[1] / self.frames

    @property
    def difference_rms_rad(self) -> Floats:
        """RMS of the difference, where both wavefronts are known, without piston: (view_row, view_column)."""
        return self._sums[2] / self.frames


def are_alike(then: Wavefront, now: Wavefront) -> bool:
    """Whether views and lenslets are the same, so that wavefronts can be subtracted."""
    return (
        then.views.shape == now.views.shape
        and np.array_equal(then.field.view_x_m, now.field.view_x_m)
        and np.array_equal(then.field.view_y_m, now.field.view_y_m)
    )

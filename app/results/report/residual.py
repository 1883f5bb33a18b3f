"""Two recordings of one sample, as the paper's Table 2 compares them: what is left when one is subtracted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.errors import InputError
from app.results.replay.comparison import are_alike
from app.results.report.summary import Summary
from reconstruction.arrays import Floats
from reconstruction.geometry import Field
from reconstruction.wavefront import rms, without_piston


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """The mean wavefronts of a recording minus those of another."""

    name: str
    other_name: str
    field: Field
    mean: Floats  # rad, (view_row, view_column, lenslet_row, lenslet_column)
    other_mean: Floats  # likewise
    views: Floats  # their difference without piston, where both are known; likewise

    @property
    def rms_rad(self) -> Floats:
        """RMS of what is left at each view, (view_row, view_column)."""
        return rms(self.views)

    @property
    def sentence(self) -> str:
        """The three numbers of the paper's Table 2."""
        values = self.rms_rad
        return (
            f"RMS of what is left at the views: least {np.nanmin(values):.3f}, most {np.nanmax(values):.3f},"
            f" mean {np.nanmean(values):.3f} rad"
        )


def residual_of(summary: Summary, other: Summary) -> Residual:
    """Subtract the mean wavefronts of `other`; `InputError` where there is nothing to subtract."""
    for each in (summary, other):
        if each.found is None:
            raise InputError(f"{each.recording.folder}: no frame has a wavefront: there is nothing to compare")
    assert summary.found is not None and other.found is not None  # noqa: S101, PT018 - just seen
    if not are_alike(summary.found.wavefront, other.found.wavefront):
        raise InputError(
            f"{other.recording.folder}: has other views or lenslets than {summary.recording.folder}: nothing to compare"
        )
    views = without_piston(summary.found.mean - other.found.mean)
    if not np.isfinite(views).any():
        raise InputError(f"{other.recording.folder}: knows none of the lenslets that {summary.recording.folder} knows")
    return Residual(
        name=summary.name,
        other_name=other.name,
        field=summary.found.wavefront.field,
        mean=summary.found.mean,
        other_mean=other.found.mean,
        views=views,
    )

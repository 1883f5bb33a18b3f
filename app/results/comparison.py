"""Difference of the mean wavefronts of two recordings or results."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.bench.config import Bench
from app.errors import InputError
from app.progress import Progress, part
from app.recording.reader import Recording
from app.recording.reprocess import Change
from app.results.replay import first_bench
from app.results.sources import mean_of_frames, read_bench_of
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.wavefront import rms, without_zernikes


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """Mean wavefronts and their difference, rad, (view_row, view_column, lenslet_row, lenslet_column)."""

    name: str
    other_name: str
    sensor: Sensor
    field: Field
    mean: Floats
    other_mean: Floats
    views: Floats  # difference without piston, where both are known

    @property
    def rms_rad(self) -> Floats:
        """RMS of the difference at each view, (view_row, view_column)."""
        return rms(self.views)

    @property
    def sentence(self) -> str:
        """The three numbers of the paper's Table 2."""
        values = self.rms_rad
        return (
            f"RMS of the difference at the views: least {np.nanmin(values):.3f}, most {np.nanmax(values):.3f},"
            f" mean {np.nanmean(values):.3f} rad"
        )


def residual_of(
    source: Path,
    other: Path,
    *,
    frames: str | None = None,
    change: Change | None = None,
    removed: frozenset[int] = frozenset(),
    progress: Progress = lambda *_: None,
) -> Residual:
    """Subtract the mean wavefront of `other`, and remove Zernike modes, by Noll's numbers, from the difference.

    `frames` and `change` are those of the first source. `InputError` if the wavefronts cannot be subtracted.
    """
    one, two = _bench_of(source, frames, change), _bench_of(other)
    nm, other_nm = (1e9 * each.sensor.wavelength_m for each in (one, two))
    if nm != other_nm:
        raise InputError(f"{other}: is at {other_nm:g} nm, {source} at {nm:g} nm: reconstruct both at one wavelength")
    _, mean = mean_of_frames(source, frames, part(progress, 0, 2), change)
    _, other_mean = mean_of_frames(other, None, part(progress, 1, 2))
    if mean.shape != other_mean.shape or not all(
        np.array_equal(getattr(one.field, axis), getattr(two.field, axis)) for axis in ("view_x_m", "view_y_m")
    ):
        size, other_size = (" x ".join(map(str, shape)) for shape in (mean.shape, other_mean.shape))
        why = f"has other views or lenslets, {other_size}, than {source}, {size}"
        raise InputError(f"{other}: {why}: reconstruct both with the same [sensor] and [field]")
    views = without_zernikes(mean - other_mean, removed, one.sensor)
    if not np.isfinite(views).any():
        raise InputError(f"{other}: has no lenslet in common with {source}")
    return Residual(source.name, other.name, one.sensor, one.field, mean, other_mean, views)


def _bench_of(source: Path, frames: str | None = None, change: Change | None = None) -> Bench:
    """Return the bench of results, or that of the first chosen frame of a recording, after a change."""
    if not source.is_dir():
        return read_bench_of(source)
    recording = Recording(source)
    return first_bench(recording, recording.select(frames), change)

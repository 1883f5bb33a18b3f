"""Display options: which part of a wavefront is shown, at which views, in which unit."""

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Self

import numpy as np

from app.errors import InputError
from app.results.sources import mean_of_frames, modes_at_views, read_bench_of
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.field_modes import FieldModes
from reconstruction.modes.polynomials import zernike_names
from reconstruction.pupil import Pupil
from reconstruction.wavefront import Wavefront, mean_known, without_piston, without_zernikes

MOST_AVERAGED = 100
MOST_VIEWS = 9  # along each side
REMOVABLE = dict(enumerate(zernike_names(28)[1:], 2))  # names of Zernike modes, by Noll's numbers
TILT = frozenset({2, 3})


class Unit(StrEnum):
    """Unit of a shown wavefront."""

    RAD = "rad"
    WAVES = "waves"
    NM = "nm"

    def per_rad(self, wavelength_m: float) -> float:
        """Return one radian in this unit."""
        waves = 1 / (2 * math.pi)
        return {Unit.RAD: 1.0, Unit.WAVES: waves, Unit.NM: waves * wavelength_m * 1e9}[self]


@dataclass(frozen=True, slots=True, eq=False)
class StoredWavefront:
    """A wavefront at every field position, to be subtracted from others."""

    name: str  # for the user
    field: Field
    modes: FieldModes
    by_mode: Floats  # wavefront of each field mode, rad, (field_mode, lenslet_row, lenslet_column); NaN where unknown

    @classmethod
    def of(cls, wavefront: Wavefront, name: str, mean: Floats | None = None) -> Self:
        """Store a frame's wavefront, or a mean that ends with it, rad, (field_mode, lenslet_row, lenslet_column)."""
        by_mode = _by_mode(wavefront) if mean is None else mean
        return cls(name, wavefront.field, wavefront.displacement.modes, by_mode)

    @classmethod
    def from_results(cls, path: Path, sensor: Sensor | None = None) -> Self:
        """Read the mean modal wavefront of results; `InputError` if there is none, or none for this `sensor`."""
        bench = read_bench_of(path)
        coefficients, views = mean_of_frames(path)
        if not coefficients.size:
            raise InputError(f"{path}: holds no coefficients: reconstruct with reconstruction.method = 'modal'")
        if sensor and (views.shape[2:], bench.sensor.wavelength_m) != (sensor.lenslets, sensor.wavelength_m):
            raise InputError(f"{path}: is of other lenslets, or of another wavelength, than the bench's")
        if (found := modes_at_views(bench, coefficients, views)) is None:  # displacements at stars, say
            raise InputError(f"{path}: its wavefront cannot be evaluated between its views")
        unknown, (pupil, modes) = np.isnan(views).all(axis=(0, 1)), found
        by_mode = np.tensordot(coefficients.T, pupil.values, axes=1)
        by_mode[:, unknown] = np.nan
        return cls(path.name, bench.field, modes, without_piston(by_mode))

    def at(self, field: Field) -> Floats:
        """Wavefronts at a field's views, rad, (view_row, view_column, lenslet_row, lenslet_column); NaN outside."""
        x, y = (view_m / self.field.half_width_m for view_m in (field.view_x_m, field.view_y_m[:, None]))
        views = np.tensordot(np.moveaxis(self.modes.values(x, y), 0, -1), self.by_mode, axes=1)
        views[~self.field.contains(x, y)] = np.nan
        return views


@dataclass(frozen=True, slots=True)
class DisplayOptions:
    """Options of the display; the defaults show the wavefront of every frame as it is."""

    removed: frozenset[int] = frozenset()  # Zernike modes, by Noll's numbers
    stored: StoredWavefront | None = None  # subtracted
    averaged: int = 1  # number of frames
    pupil: Pupil | None = None  # in place of that of the bench
    views: int | None = None  # along each side of a square grid; None: those of the bench

    @property
    def in_words(self) -> str:
        """The options other than the defaults, for a caption; empty without any."""
        tilt = TILT if self.removed >= TILT else frozenset[int]()
        removed = [*["tilt"] * bool(tilt), *(REMOVABLE[number].split()[0] for number in sorted(self.removed - tilt))]
        parts = (
            f"no {', '.join(removed)}" * bool(removed),
            "" if self.stored is None else f"minus {self.stored.name}",
            "" if self.pupil is None else self.pupil.in_words,
            f"mean of {self.averaged} frames" * (self.averaged > 1),
        )
        return ", ".join(filter(None, parts))


class WavefrontDisplay:
    """Applies display options to successive wavefronts."""

    def __init__(self) -> None:
        self.options = DisplayOptions()
        self._recent: deque[Floats] = deque()  # wavefronts of each field mode, newest last
        self._newest: Wavefront | None = None

    def __call__(self, wavefront: Wavefront) -> Wavefront:
        """Return a wavefront with the `views` to show; its solution stays that of the newest frame."""
        options, by_mode = self.options, self._mean(wavefront)
        shown, field = wavefront, wavefront.field
        if options.views is not None:
            field = with_views(field, options.views)
            shown = Wavefront.of(wavefront.sensor, field, wavefront.displacement, wavefront.solution)
        if by_mode is not None:
            shown = replace(shown, views=without_piston(StoredWavefront.of(wavefront, "mean", by_mode).at(field)))
        if options.stored is not None:
            shown = replace(shown, views=without_piston(shown.views - options.stored.at(field)))
        if options.pupil is not None:
            sensor = replace(wavefront.sensor, pupil=options.pupil)
            inside = np.where(sensor.is_in_pupil, shown.views, np.nan)
            shown = replace(shown, sensor=sensor, views=without_piston(inside))
        if options.removed:
            shown = replace(shown, views=without_zernikes(shown.views, options.removed, shown.sensor))
        return shown

    def store(self, wavefront: Wavefront, name: str) -> StoredWavefront:
        """Return the wavefront, averaged like the shown one, to be subtracted later."""
        return StoredWavefront.of(wavefront, name, self._mean(wavefront))

    def _mean(self, wavefront: Wavefront) -> Floats | None:
        """Include a wavefront in the mean, and return that, by field mode; None without averaging."""
        if self.options.averaged == 1:
            self._recent.clear()
            return None
        newest, self._newest = self._newest, wavefront
        if newest is not wavefront or not self._recent:
            by_mode = _by_mode(wavefront)
            if newest is None or newest.displacement.modes != wavefront.displacement.modes:
                self._recent.clear()
            self._recent.append(by_mode)
        while len(self._recent) > self.options.averaged:
            self._recent.popleft()
        return mean_known(np.array(self._recent), axis=(0,))


def with_views(field: Field, count: int) -> Field:
    """Return a field with count x count views over the area of its own, or over all of it."""
    reach_m = (max(field.view_rows, field.view_columns) - 1) / 2 * field.view_spacing_m
    if not reach_m:
        reach_m = field.half_width_m * (1 - 1 / count)
    spacing_m = 2 * reach_m / (count - 1) if count > 1 else field.view_spacing_m
    return replace(field, view_rows=count, view_columns=count, view_spacing_m=spacing_m)


def _by_mode(wavefront: Wavefront) -> Floats:
    return wavefront.solution.wavefront(np.eye(wavefront.displacement.modes.count))

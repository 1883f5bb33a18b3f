"""Coefficients and RMS of every frame as CSV: one row a frame, numbers only, for pandas, NumPy or a spreadsheet."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from app.errors import InputError, RunError
from app.files import atomic_write
from app.recording.reprocess import Reprocessed
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront, rms


def write_table(path: Path, frames: Iterable[Reprocessed]) -> None:
    """Write the table; a frame without a wavefront has nan. The head names each column with its unit.

    `rms_R_C_rad` is the RMS at view row R, view column C, `e_P_Q_rad` the coefficient of pupil mode P and field mode Q,
    `e_P_Q_sigma_rad` its standard deviation; with the zonal method there are none.
    """
    remaining = iter(frames)
    before: list[Reprocessed] = []  # the first that has a wavefront says which columns there are
    for frame in remaining:
        before.append(frame)
        if frame.wavefront is not None:
            break
    else:
        raise RunError(f"{path}: there is nothing to write: no frame has a wavefront")
    names = [name for name, _ in _values(frame.wavefront)]
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="ascii") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "camera_frame", "time_s", "exposure_s", "em_gain", "valid_lenslets", *names])
        writer.writerows(_row(each, names) for each in chain(before, remaining))


def _row(frame: Reprocessed, names: list[str]) -> list[float]:
    line, found = frame.line, dict.fromkeys(names, np.nan)
    if frame.wavefront is not None:
        found = dict(_values(frame.wavefront))
        if list(found) != names:
            raise InputError("the settings changed between the frames: choose some that go together")
    valid = 0 if frame.registered is None else int(frame.registered.valid.sum())
    return [line.index, line.camera_index, line.camera_time_s, line.exposure_s, line.em_gain, valid, *found.values()]


def _values(wavefront: Wavefront) -> Iterator[tuple[str, float]]:
    """What the table says of a wavefront, by the names of the columns."""
    for (row, column), value in np.ndenumerate(rms(wavefront.views)):
        yield f"rms_{row}_{column}_rad", float(value)
    if isinstance(wavefront.solution, ModalSolution):
        for name, values in (("", wavefront.solution.coefficients), ("_sigma", wavefront.solution.coefficients_sigma)):
            for (pupil_mode, field_mode), value in np.ndenumerate(values):
                yield f"e_{pupil_mode}_{field_mode}{name}_rad", float(value)

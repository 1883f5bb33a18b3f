"""Steps of the guided calibration: lattice, exposure, dark, reference."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.acquisition.instrument import Instrument, Status
from app.acquisition.worker import Acquisition
from reconstruction.geometry import Lattice

_SAME_LATTICE = 0.05  # of the pitch; frames are doubted beyond


@dataclass(frozen=True, slots=True)
class CalibrationStep:
    """One routine of the worker; it restores the devices, also when it is cancelled."""

    title: str
    explanation: str
    is_lit: bool  # whether its frames need the light
    begin: Callable[[Acquisition, int], Future[Any]]  # `int`: number of averaged frames


LATTICE = CalibrationStep(
    "Lattice", "Finds the lenslets in a few frames without the sample.", True, lambda to, _: to.find_lattice()
)
EXPOSURE = CalibrationStep(
    "Exposure",
    "Sets the exposure, and if needed the light's current, so that the brightest lenslets fill 70 % of the range.",
    True,
    lambda to, _: to.expose_without_sample(),
)
DARK = CalibrationStep(
    "Dark", "Averages frames with the light off: the background of all frames.", False, Acquisition.take_dark
)
REFERENCE = CalibrationStep(
    "Reference",
    "Averages frames with the light on and without the sample: the zero point of the displacements.",
    True,
    Acquisition.take_reference,
)
STEPS = (LATTICE, EXPOSURE, DARK, REFERENCE)


def by_hand(step: CalibrationStep, status: Status) -> tuple[str, Callable[[Instrument], None]] | None:
    """Return what a person must do before a step, and the command that notes it; None if nothing."""

    def note_light(instrument: Instrument) -> None:
        instrument.devices.light.note_light(step.is_lit)

    def note_sample(instrument: Instrument) -> None:
        instrument.devices.stage.note_sample(False)

    if status.bench.has_manual_light and status.is_light_on != step.is_lit:
        return f"switch the light {'on' if step.is_lit else 'off'} by hand", note_light
    if status.bench.has_manual_stage and step.is_lit and status.is_sample_in:
        return "take the sample out of the beam", note_sample
    return None


def differs(found: Lattice, status: Status) -> bool:
    """Return whether a lattice lies beside that of the bench by more than a twentieth of the pitch at any lenslet."""
    sensor, before = status.bench.sensor, status.bench.lattice
    if before is None:
        return False  # the reference will show it
    shape = sensor.lenslet_rows, sensor.lenslet_columns
    moved_px = found.lenslet_centers_px(*shape) - before.lenslet_centers_px(*shape)
    return bool(np.linalg.norm(moved_px, axis=-1).max() > _SAME_LATTICE * before.pitch_px)

"""Start of a bench: the commands that calibrate it, also step by step with a person."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.acquisition.instrument import DeviceSetting, Instrument, Status
from app.acquisition.running_instrument import RunningInstrument
from app.bench.config import Bench
from app.measurement.auto_exposure import FILL
from app.measurement.averages import FRAMES
from reconstruction.geometry import Lattice

_SAME_LATTICE = 0.05  # of the pitch; frames are doubted beyond


def start_up(acquisition: RunningInstrument, frames: int = FRAMES, *, is_lit: bool = True) -> tuple[Future[Any], ...]:
    """Turn the light on, take a dark and a reference, move the sample in and start the camera.

    The steps run in order; cancelling one skips only that one. With a manual stage the position of the sample is
    unknown: the camera starts after the dark, and the user requests the reference. Unless `is_lit`, the light stays
    off, and there is no reference.
    """
    has_motor, steps = not acquisition.bench.has_manual_stage, list[Future[Any]]()
    if is_lit:
        steps.append(acquisition.submit(Instrument.set, "is_light_on", True))
    steps.append(acquisition.submit(Instrument.take_dark, frames))
    if is_lit and has_motor:
        steps.append(acquisition.submit(Instrument.take_reference, frames))
    if has_motor:
        steps.append(acquisition.submit(Instrument.set, "is_sample_in", True))
    return (*steps, acquisition.submit(Instrument.set, "is_running", True))


def knows_sample(acquisition: RunningInstrument) -> bool:
    """True if sample and correction of the newest frame are known, if it has any.

    It stays false with few frames: the first search takes some seconds, the first correction some more.
    """
    newest = acquisition.newest
    if newest is None or not newest.counts.acquired:
        return False
    return newest.assumed.sample is not None and newest.assumed.refinement.stage != "preparing"


@dataclass(frozen=True, slots=True)
class CalibrationStep:
    """One routine of the guided calibration; it restores the devices, also when it is cancelled."""

    title: str
    explanation: str
    is_lit: bool  # whether its frames need the light
    request: Callable[..., Any]  # of the instrument
    takes_frames: bool = False  # whether the request takes the number of averaged frames

    def begin(self, acquisition: RunningInstrument, frames: int) -> Future[Any]:
        """Send the request."""
        return acquisition.submit(self.request, *([frames] if self.takes_frames else []))


LATTICE = CalibrationStep(
    "Lattice", "Finds the lenslets in a few frames without the sample", is_lit=True, request=Instrument.find_lattice
)
EXPOSURE = CalibrationStep(
    "Exposure",
    "Sets the exposure, and if needed the light's current, so that the brightest lenslets fill"
    f" {100 * FILL:.0f} % of the range",
    is_lit=True,
    request=Instrument.expose_without_sample,
)
DARK = CalibrationStep(
    "Dark",
    "Averages frames with the light off: the background of all frames",
    is_lit=False,
    request=Instrument.take_dark,
    takes_frames=True,
)
REFERENCE = CalibrationStep(
    "Reference",
    "Averages frames with the light on and without the sample: the zero point of the displacements",
    is_lit=True,
    request=Instrument.take_reference,
    takes_frames=True,
)
STEPS = (LATTICE, EXPOSURE, DARK, REFERENCE)


def by_hand(step: CalibrationStep, status: Status) -> tuple[str, DeviceSetting, bool] | None:
    """Return what a person must do before a step, the setting that notes it, and its value, if any."""
    if status.bench.has_manual_light and status.is_light_on != step.is_lit:
        return f"switch the light {'on' if step.is_lit else 'off'} by hand", "is_light_on", step.is_lit
    if status.bench.has_manual_stage and step.is_lit and status.is_sample_in:
        return "take the sample out of the beam", "is_sample_in", False
    return None


def without_sample(bench: Bench) -> str:
    """Return what a person must do before light without the sample is measured; empty if motors do it."""
    if not bench.has_manual_stage:
        return ""
    return f"take the sample out of the beam, put the mask {bench.simulation.source.mask} in"


def has_moved(found: Lattice, status: Status) -> bool:
    """True if a lattice lies beside that of the bench by more than 5 % of the pitch anywhere."""
    sensor, before = status.bench.sensor, status.bench.lattice
    if before is None:
        return False  # the reference will show it
    shape = sensor.lenslet_rows, sensor.lenslet_columns
    moved_px = found.lenslet_centers_px(*shape) - before.lenslet_centers_px(*shape)
    return bool(np.linalg.norm(moved_px, axis=-1).max() > _SAME_LATTICE * before.pitch_px)

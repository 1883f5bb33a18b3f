"""What every camera must do."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np

from drivers.camera import Camera
from drivers.contract.device import Calls, check_properties, require, require_all_raise, require_raises
from drivers.errors import BadValue, DeviceTimeout, FrameLost, Unsupported, WrongState
from drivers.frame import Frame, Region

_NAN = float("nan")
_SHORT_S = 0.05  # long enough that no frame can be there at once
_LONG_S = 3.8
_STEP_S = 1e-6  # many cameras count exposures in microseconds
_MARGIN_S = 5.0  # beyond the exposure, until a frame must have come
_AT_ONCE_S = 2.0


def check_tells_what_it_is(camera: Camera) -> None:
    """It says what it is and what it allows, and what is set lies in that."""
    check_properties(camera)
    check_settings_are_allowed(camera)
    allowed = camera.capabilities
    for what, number in {
        "rows": allowed.rows,
        "columns": allowed.columns,
        "pixel_pitch_m": 1.0 if allowed.pixel_pitch_m is None else allowed.pixel_pitch_m,
        "full_scale": allowed.full_scale,
        "the shortest exposure": allowed.exposure_range_s.minimum,
    }.items():
        require(number > 0, f"{what} = {number} is not positive")


def check_settings_are_allowed(camera: Camera) -> None:
    """Everything in force is one of the values that are allowed."""
    allowed = camera.capabilities
    allowed.exposure_range_s.check(camera.exposure_s, "exposure_s")
    allowed.em_gain_range.check(camera.em_gain, "em_gain")
    for what, value, values in (
        ("amplifier", camera.amplifier, allowed.amplifiers),
        ("readout speed", camera.readout_speed, allowed.readout_speeds),
        ("binning", camera.binning, allowed.binnings),
        ("trigger", camera.trigger, allowed.triggers),
    ):
        require(value in values, f"the {what} is {value!r}, which is none of {values}")


def check_rests_until_it_is_started(camera: Camera) -> None:
    """It does not run, and gives no frame, before it is started."""
    require(not camera.is_running and camera.state == "stopped", "it runs before it was started")
    require_raises(WrongState, "read before start", lambda: camera.read(0.0))


def check_frames(camera: Camera) -> None:
    """Frames count from 0, say how they were taken, and belong to whoever reads them."""
    with _running(camera):
        require(camera.is_running and camera.state == "running", "it was started and does not run")
        frames = [_next(camera) for _ in range(3)]
        allowed = camera.capabilities
        require([frame.index for frame in frames] == [0, 1, 2], f"frames {[frame.index for frame in frames]} came")
        for frame in frames:
            require(frame.pixels.shape == (allowed.rows, allowed.columns), f"a frame is {frame.pixels.shape}")
            require(frame.pixels.dtype == np.uint16, f"a frame is of {frame.pixels.dtype}")
            require(not frame.pixels.flags.writeable, "a frame can be written to")
            require(int(frame.pixels.max()) <= allowed.full_scale, "a count is above full scale")
            require(frame.exposure_s == camera.exposure_s, "a frame tells another exposure than the camera")
            require(frame.em_gain == camera.em_gain, "a frame tells another gain than the camera")
        require(not np.shares_memory(frames[0].pixels, frames[1].pixels), "two frames share their memory")
        steps_s = np.diff([frame.camera_time_s for frame in frames])
        require(bool((steps_s >= 0.9 * camera.exposure_s).all()), f"frames end {steps_s} s after one another")


def check_timeout(camera: Camera) -> None:
    """A read that is too early times out and loses nothing; a timeout must be a time."""
    allowed = camera.capabilities.exposure_range_s
    camera.set_exposure(min(max(_SHORT_S, allowed.minimum), allowed.maximum))
    with _running(camera):
        require_raises(DeviceTimeout, "a read at once", lambda: camera.read(0.0))
        for timeout_s in (_NAN, -1.0, float("inf")):
            require_raises(BadValue, f"a timeout of {timeout_s}", camera.read, timeout_s)
        require(_next(camera).index == 0, "the read that timed out lost a frame")


def check_starts_anew(camera: Camera) -> None:
    """It can be started again and again, counting from 0; not twice, but stopped twice."""
    for _ in range(2):
        with _running(camera):
            require_raises(WrongState, "a second start", camera.start)
            require(_next(camera).index == 0, "the first frame after a start is not number 0")
        camera.stop()
        require(not camera.is_running, "it runs after it was stopped")
        require_raises(WrongState, "read after stop", lambda: camera.read(0.0))


def check_pauses(camera: Camera) -> None:
    """It pauses for a change and then goes on, also when the change is refused; stopped, it stays so."""
    with camera.paused():
        require(not camera.is_running, "a pause started it")
    require(not camera.is_running, "the end of a pause started it though it was stopped")
    with _running(camera):
        for exposure_s in (camera.exposure_s, _NAN):
            with suppress(BadValue), camera.paused():
                require(not camera.is_running, "it runs in a pause")
                camera.set_exposure(exposure_s)
            require(_next(camera).index == 0, "the first frame after a pause is not number 0")


def check_exposures(camera: Camera) -> None:
    """It takes the exposures that it allows, rounds them stably, and refuses all others."""
    allowed = camera.capabilities.exposure_range_s
    longer_s = min(allowed.maximum, 1.234567 * allowed.minimum)
    for exposure_s in (allowed.maximum, allowed.minimum, longer_s):
        taken_s = camera.set_exposure(exposure_s)
        require(camera.exposure_s == taken_s, f"{taken_s} s was said to be in force, {camera.exposure_s} s is")
        require(abs(taken_s - exposure_s) < max(0.01 * exposure_s, _STEP_S), f"{exposure_s} s became {taken_s} s")
        require(camera.set_exposure(taken_s) == taken_s, f"{taken_s} s, once given, is not taken again")
    for exposure_s in (0.0, -1.0, _NAN, 0.9 * allowed.minimum, 1.1 * allowed.maximum, float("inf")):
        require_raises(BadValue, f"{exposure_s} s", camera.set_exposure, exposure_s)
    require(camera.exposure_s == taken_s, "a refused exposure did not leave the one before")
    camera.set_exposure(allowed.minimum)


def check_exposure_while_running(camera: Camera) -> None:
    """The exposure can be changed while it runs, and frames tell it."""
    allowed = camera.capabilities.exposure_range_s
    camera.set_exposure(allowed.minimum)
    with _running(camera):
        longer_s = camera.set_exposure(min(2 * allowed.minimum, allowed.maximum))
        require(camera.is_running, "a change of exposure stopped it")
        frames = [_next(camera) for _ in range(6)]
        require(frames[-1].exposure_s == longer_s, f"after six frames still {frames[-1].exposure_s} s")
    camera.set_exposure(allowed.minimum)


def check_gain(camera: Camera) -> None:
    """The gain stays in its range, and a refused one leaves the one before."""
    allowed = camera.capabilities.em_gain_range
    for em_gain in (allowed.minimum + (allowed.maximum - allowed.minimum) / 10, allowed.minimum):
        taken = camera.set_em_gain(em_gain)
        require(camera.em_gain == taken, f"a gain of {taken} was said to be in force, {camera.em_gain} is")
        require(abs(taken - em_gain) <= 1, f"a gain of {em_gain} became {taken}")
    for em_gain in (_NAN, allowed.minimum - 1, allowed.maximum + 1):
        require_raises(BadValue, f"a gain of {em_gain}", camera.set_em_gain, em_gain)
    require(camera.em_gain == taken, "a refused gain did not leave the one before")


def check_modes(camera: Camera) -> None:
    """Every amplifier, readout speed, binning and trigger can be used, and what is set stays allowed."""
    first = camera.capabilities
    speed = camera.readout_speed
    for amplifier in (*first.amplifiers, camera.amplifier):
        camera.set_amplifier(amplifier)
        require(camera.amplifier == amplifier, f"the amplifier is not {amplifier}")
        for readout_speed in camera.capabilities.readout_speeds:
            camera.set_readout_speed(readout_speed)
            require(camera.readout_speed == readout_speed, f"the readout speed is not {readout_speed}")
            check_settings_are_allowed(camera)
    camera.set_readout_speed(speed)
    for trigger in (*first.triggers, camera.trigger):
        camera.set_trigger(trigger)
        require(camera.trigger == trigger, f"the trigger is not {trigger}")
        check_settings_are_allowed(camera)
    for binning in (*first.binnings, camera.binning):
        camera.set_binning(binning)
        require(camera.binning == binning, f"the binning is not {binning}")
        check_settings_are_allowed(camera)
        _check_one_frame(camera)


def check_region(camera: Camera) -> None:
    """A part of the sensor can be read out where that is offered, in its steps and no other."""
    allowed = camera.capabilities
    if allowed.sensor is None:
        require_raises(Unsupported, "a region", lambda: camera.set_region(camera.region))
        return
    whole, step_px, before = allowed.sensor, allowed.region_step_px, camera.region
    require(camera.set_region(whole) == whole, "all of its sensor cannot be read out")
    rows, columns = (max(length // 2 // step_px, 1) * step_px for length in (whole.rows, whole.columns))
    if rows + step_px <= whole.rows and columns + step_px <= whole.columns:
        part = Region(step_px, step_px, rows, columns)
        require(camera.set_region(part) == camera.region, "another region is in force than was said")
        _check_one_frame(camera)
    for bad in (
        Region(0, 0, whole.rows + step_px, whole.columns),
        Region(-step_px, 0, rows, columns),
        Region(0, 0, 0, columns),
    ):
        require_raises(BadValue, f"{bad}", camera.set_region, bad)
    camera.set_region(before)
    require(camera.region == before, "it does not come back to the region before")


def check_refuses_unknown_modes(camera: Camera) -> None:
    """A mode that it does not have is refused, and any other mode while it runs."""
    unknown: Calls = {
        "an unknown amplifier": lambda: camera.set_amplifier("no such amplifier"),
        "an unknown readout speed": lambda: camera.set_readout_speed(99),
        "an unknown binning": lambda: camera.set_binning(99),
        "an unknown trigger": lambda: camera.set_trigger("no such trigger"),
    }
    require_all_raise(BadValue, unknown)
    with _running(camera):
        locked: dict[str, Callable[[], object]] = {
            "another amplifier while running": lambda: camera.set_amplifier(camera.amplifier),
            "another readout speed while running": lambda: camera.set_readout_speed(camera.readout_speed),
            "another binning while running": lambda: camera.set_binning(camera.binning),
            "another trigger while running": lambda: camera.set_trigger(camera.trigger),
        }
        if camera.capabilities.sensor is not None:
            locked["another region while running"] = lambda: camera.set_region(camera.region)
        require_all_raise(WrongState, locked)
        require(_next(camera).index == 0, "what was refused disturbed the frames")


def check_stops_at_once(camera: Camera) -> None:
    """It stops at once, also in the middle of a long exposure."""
    allowed = camera.capabilities.exposure_range_s
    camera.set_exposure(min(_LONG_S, allowed.maximum))
    camera.start()
    started_s = time.monotonic()
    camera.stop()
    took_s = time.monotonic() - started_s
    camera.set_exposure(allowed.minimum)
    require(took_s < _AT_ONCE_S, f"it took {took_s:.1f} s to stop")


def check_closes_for_good(camera: Camera) -> None:
    """It closes while it runs, twice, and answers nothing afterwards but that it is closed."""
    camera.start()
    camera.close()
    camera.close()
    require(camera.state == "closed", f"closed, its state is {camera.state}")
    require_all_raise(WrongState, calls_of(camera))


def check_opens_anew(camera: Camera, reopen: Callable[[], Camera]) -> None:
    """It can be opened again after it was closed."""
    camera.close()
    with reopen() as again:
        require(again.state == "stopped", f"opened anew, its state is {again.state}")
        _check_one_frame(again)


def calls_of(camera: Camera) -> Calls:
    """Every question and command there is."""
    return {
        "capabilities": lambda: camera.capabilities,
        "exposure_s": lambda: camera.exposure_s,
        "set_exposure": lambda: camera.set_exposure(0.1),
        "em_gain": lambda: camera.em_gain,
        "set_em_gain": lambda: camera.set_em_gain(1.0),
        "amplifier": lambda: camera.amplifier,
        "set_amplifier": lambda: camera.set_amplifier("normal"),
        "readout_speed": lambda: camera.readout_speed,
        "set_readout_speed": lambda: camera.set_readout_speed(1),
        "binning": lambda: camera.binning,
        "set_binning": lambda: camera.set_binning(1),
        "trigger": lambda: camera.trigger,
        "set_trigger": lambda: camera.set_trigger("internal"),
        "region": lambda: camera.region,
        "set_region": lambda: camera.set_region(Region(0, 0, 16, 16)),
        "properties": camera.properties,
        "is_running": lambda: camera.is_running,
        "start": camera.start,
        "stop": camera.stop,
        "read": lambda: camera.read(0.0),
    }


CAMERA_CHECKS: tuple[Callable[[Camera], None], ...] = (
    check_tells_what_it_is,
    check_rests_until_it_is_started,
    check_frames,
    check_timeout,
    check_starts_anew,
    check_pauses,
    check_exposures,
    check_exposure_while_running,
    check_gain,
    check_modes,
    check_region,
    check_refuses_unknown_modes,
    check_stops_at_once,
)


@contextmanager
def _running(camera: Camera) -> Iterator[None]:
    camera.start()
    yield
    camera.stop()


def _next(camera: Camera) -> Frame:
    """The next frame that comes whole."""
    for _ in range(10):
        try:
            return camera.read(camera.exposure_s + _MARGIN_S)
        except FrameLost:
            continue
    raise DeviceTimeout("ten frames in a row came damaged")


def _check_one_frame(camera: Camera) -> None:
    """Require that a frame has the shape that was told."""
    allowed = camera.capabilities
    with _running(camera):
        shape = _next(camera).pixels.shape
        require(shape == (allowed.rows, allowed.columns), f"a frame is {shape}, not as told")

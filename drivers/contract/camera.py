"""Contract of all cameras."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np

from drivers.camera import INTERNAL, Camera, Frame, Region
from drivers.contract import Calls, ContractBroken, calls, check_properties, require, require_all_raise, require_raises
from drivers.errors import BadValue, DeviceTimeout, FrameLost, Unsupported, WrongState

_NAN = float("nan")
_MODES = ("amplifier", "readout_speed", "binning", "trigger")
_SHORT_S = 0.05  # too long for a frame to be ready at once
_LONG_S = 3.8
_STEP_S = 1e-6  # many cameras count exposures in microseconds
_MARGIN_S = 5.0  # for a frame, beyond its exposure
_AT_ONCE_S = 2.0
_ATTEMPTS = 10


def check_identity(camera: Camera) -> None:
    """Its properties, capabilities and settings are valid."""
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
    """All settings in force are allowed."""
    allowed = camera.capabilities
    allowed.exposure_range_s.check(camera.exposure_s, "exposure_s")
    allowed.em_gain_range.check(camera.em_gain, "em_gain")
    for mode in _MODES:
        value, values = getattr(camera, mode), getattr(allowed, f"{mode}s")
        require(value in values, f"{mode} is {value!r}, which is none of {values}")


def check_rests_before_start(camera: Camera) -> None:
    """It does not run and returns no frame before it is started."""
    require(not camera.is_running and camera.state == "stopped", "it runs before start")
    require_raises(WrongState, "read before start", lambda: camera.read(0.0))


def check_frames(camera: Camera) -> None:
    """Frames count from 0, carry their settings, and share no memory."""
    with _running(camera):
        require(camera.is_running and camera.state == "running", "it does not run after start")
        frames = [_next(camera) for _ in range(3)]
        allowed = camera.capabilities
        require([frame.index for frame in frames] == [0, 1, 2], f"frames {[frame.index for frame in frames]} came")
        for frame in frames:
            require(frame.pixels.shape == (allowed.rows, allowed.columns), f"a frame is {frame.pixels.shape}")
            require(frame.pixels.dtype == np.uint16, f"a frame is of {frame.pixels.dtype}")
            require(not frame.pixels.flags.writeable, "a frame can be written to")
            require(int(frame.pixels.max()) <= allowed.full_scale, "a count is above full scale")
            require(frame.exposure_s == camera.exposure_s, "a frame has another exposure than the camera")
            require(frame.em_gain == camera.em_gain, "a frame has another gain than the camera")
        require(not np.shares_memory(frames[0].pixels, frames[1].pixels), "two frames share their memory")
        steps_s = np.diff([frame.camera_time_s for frame in frames])
        require(bool((steps_s >= 0.9 * camera.exposure_s).all()), f"frames end {steps_s} s after one another")


def check_timeout(camera: Camera) -> None:
    """A read with too short a timeout raises and loses no frame; an invalid timeout is refused."""
    allowed = camera.capabilities.exposure_range_s
    camera.set_exposure(allowed.nearest(_SHORT_S))
    for _ in range(_ATTEMPTS):
        started_s = time.monotonic()
        with _running(camera):
            try:
                require_raises(DeviceTimeout, "a read with timeout 0", lambda: camera.read(0.0))
            except ContractBroken as error:
                broken = error
                if time.monotonic() - started_s < camera.exposure_s:
                    raise
                continue  # this computer was late, and a frame may have come
            for timeout_s in (_NAN, -1.0, float("inf")):
                require_raises(BadValue, f"a timeout of {timeout_s}", camera.read, timeout_s)
            require(_next(camera).index == 0, "the read that timed out lost a frame")
            return
    raise broken


def check_restarts(camera: Camera) -> None:
    """It restarts with frame 0; a second start is refused, a second stop allowed."""
    for _ in range(2):
        with _running(camera):
            require_raises(WrongState, "a second start", camera.start)
            require(_next(camera).index == 0, "the first frame after a start is not number 0")
        camera.stop()
        require(not camera.is_running, "it runs after stop")
        require_raises(WrongState, "read after stop", lambda: camera.read(0.0))


def check_pauses(camera: Camera) -> None:
    """A pause restarts it afterwards, also after a refused change; if stopped, it stays so."""
    with camera.paused():
        require(not camera.is_running, "a pause started it")
    require(not camera.is_running, "the end of a pause started it")
    with _running(camera):
        for exposure_s in (camera.exposure_s, _NAN):
            with suppress(BadValue), camera.paused():
                require(not camera.is_running, "it runs in a pause")
                camera.set_exposure(exposure_s)
            require(_next(camera).index == 0, "the first frame after a pause is not number 0")


def check_exposures(camera: Camera) -> None:
    """It accepts all allowed exposures, rounds them stably, and refuses others."""
    allowed = camera.capabilities.exposure_range_s
    longer_s = min(allowed.maximum, 1.234567 * allowed.minimum)
    for exposure_s in (allowed.maximum, allowed.minimum, longer_s):
        taken_s = camera.set_exposure(exposure_s)
        require(camera.exposure_s == taken_s, f"{camera.exposure_s} s is in force, not {taken_s} s as it returned")
        require(abs(taken_s - exposure_s) < max(0.01 * exposure_s, _STEP_S), f"{exposure_s} s became {taken_s} s")
        require(camera.set_exposure(taken_s) == taken_s, f"{taken_s} s, once in force, is not accepted again")
    for exposure_s in (0.0, -1.0, _NAN, 0.9 * allowed.minimum, 1.1 * allowed.maximum, float("inf")):
        require_raises(BadValue, f"{exposure_s} s", camera.set_exposure, exposure_s)
    require(camera.exposure_s == taken_s, "a refused exposure changed the one in force")
    camera.set_exposure(allowed.minimum)


def check_exposure_while_running(camera: Camera) -> None:
    """The exposure changes while it runs, and frames report it."""
    allowed = camera.capabilities.exposure_range_s
    camera.set_exposure(allowed.minimum)
    with _running(camera):
        longer_s = camera.set_exposure(min(2 * allowed.minimum, allowed.maximum))
        require(camera.is_running, "a change of exposure stopped it")
        _skip_waiting(camera, longer_s)
        frames = [_next(camera) for _ in range(6)]
        require(frames[-1].exposure_s == longer_s, f"after six frames still {frames[-1].exposure_s} s")
    camera.set_exposure(allowed.minimum)


def check_gain(camera: Camera) -> None:
    """It accepts gains in its range; a refused one changes nothing."""
    allowed = camera.capabilities.em_gain_range
    for em_gain in (allowed.minimum + (allowed.maximum - allowed.minimum) / 10, allowed.minimum):
        taken = camera.set_em_gain(em_gain)
        require(camera.em_gain == taken, f"a gain of {camera.em_gain} is in force, not {taken} as it returned")
        require(abs(taken - em_gain) <= 1, f"a gain of {em_gain} became {taken}")
    for em_gain in (_NAN, allowed.minimum - 1, allowed.maximum + 1):
        require_raises(BadValue, f"a gain of {em_gain}", camera.set_em_gain, em_gain)
    require(camera.em_gain == taken, "a refused gain changed the one in force")


def check_modes(camera: Camera) -> None:
    """Every amplifier, readout speed, binning and trigger can be used; all settings stay allowed."""
    first, first_speed = camera.capabilities, camera.readout_speed
    for amplifier in (*first.amplifiers, camera.amplifier):
        camera.set_amplifier(amplifier)
        require(camera.amplifier == amplifier, f"the amplifier is not {amplifier}")
        for readout_speed in camera.capabilities.readout_speeds:
            _set_mode(camera, "readout_speed", readout_speed)
    camera.set_readout_speed(first_speed)
    for trigger in (*first.triggers, camera.trigger):
        _set_mode(camera, "trigger", trigger)
    for binning in (*first.binnings, camera.binning):
        _set_mode(camera, "binning", binning)
        _check_one_frame(camera)


def check_region(camera: Camera) -> None:
    """Regions of the sensor, if offered, are accepted in whole steps only."""
    allowed = camera.capabilities
    if allowed.sensor is None:
        require_raises(Unsupported, "a region", lambda: camera.set_region(camera.region))
        return
    whole, step_px, before = allowed.sensor, allowed.region_step_px, camera.region
    require(camera.set_region(whole) == whole, "its whole sensor cannot be read out")
    rows, columns = (max(length // 2 // step_px, 1) * step_px for length in (whole.rows, whole.columns))
    if rows + step_px <= whole.rows and columns + step_px <= whole.columns:
        part = Region(step_px, step_px, rows, columns)
        require(camera.set_region(part) == camera.region, "another region is in force than it returned")
        _check_one_frame(camera)
    for bad in (
        Region(0, 0, whole.rows + step_px, whole.columns),
        Region(0, 0, whole.rows, whole.columns + step_px),
        Region(-step_px, 0, rows, columns),
        Region(0, -step_px, rows, columns),
        Region(0, 0, 0, columns),
        Region(0, 0, rows, 0),
    ):
        require_raises(BadValue, f"{bad}", camera.set_region, bad)
    camera.set_region(before)
    require(camera.region == before, "it does not return to its former region")


def check_refuses_unknown_modes(camera: Camera) -> None:
    """It refuses unknown modes, and any change of mode while it runs."""
    unknown = {"amplifier": "unknown", "readout_speed": 99, "binning": 99, "trigger": "unknown"}
    require_all_raise(BadValue, calls(camera, (), {f"set_{mode}": (value,) for mode, value in unknown.items()}))
    with _running(camera):
        locked = _MODES if camera.capabilities.sensor is None else (*_MODES, "region")
        require_all_raise(WrongState, calls(camera, (), {f"set_{mode}": (getattr(camera, mode),) for mode in locked}))
        require(_next(camera).index == 0, "a refused change disturbed the frames")


def check_stops_at_once(camera: Camera) -> None:
    """It stops at once, also during a long exposure."""
    allowed = camera.capabilities.exposure_range_s
    camera.set_exposure(min(_LONG_S, allowed.maximum))
    camera.start()
    started_s = time.monotonic()
    camera.stop()
    took_s = time.monotonic() - started_s
    camera.set_exposure(allowed.minimum)
    require(took_s < _AT_ONCE_S, f"it took {took_s:.1f} s to stop")


def check_closes(camera: Camera) -> None:
    """It closes while running, and twice; every later call raises."""
    camera.start()
    camera.close()
    camera.close()
    require(camera.state == "closed", f"closed, its state is {camera.state}")
    require_all_raise(WrongState, calls_of(camera))


def check_reopens(camera: Camera, reopen: Callable[[], Camera]) -> None:
    """It reopens after it was closed."""
    camera.close()
    with reopen() as again:
        require(again.state == "stopped", f"reopened, its state is {again.state}")
        _check_one_frame(again)


def calls_of(camera: Camera) -> Calls:
    """Every query and command."""
    settings: dict[str, tuple[object, ...]] = {
        "set_exposure": (0.1,),
        "set_em_gain": (1.0,),
        "set_amplifier": ("normal",),
        "set_readout_speed": (1,),
        "set_binning": (1,),
        "set_trigger": (INTERNAL,),
        "set_region": (Region(0, 0, 16, 16),),
    }
    queries = ("capabilities", "exposure_s", "em_gain", *_MODES, "region", "is_running")
    return calls(camera, queries, settings | {"properties": (), "start": (), "stop": (), "read": (0.0,)})


CAMERA_CHECKS: tuple[Callable[[Camera], None], ...] = (
    check_identity,
    check_rests_before_start,
    check_frames,
    check_timeout,
    check_restarts,
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
    """Run a camera, which rests afterwards, also if a check fails."""
    camera.start()
    try:
        yield
    finally:
        camera.stop()


def _skip_waiting(camera: Camera, exposure_s: float) -> None:
    """Read the frames that wait in the camera, up to the first of this exposure."""
    deadline_s = time.monotonic() + _MARGIN_S
    with suppress(DeviceTimeout):
        while _next(camera, 0.0).exposure_s != exposure_s and time.monotonic() < deadline_s:
            pass


def _next(camera: Camera, timeout_s: float | None = None) -> Frame:
    """Read the next undamaged frame, by default with enough time for it."""
    timeout_s = camera.exposure_s + _MARGIN_S if timeout_s is None else timeout_s
    for _ in range(10):
        try:
            return camera.read(timeout_s)
        except FrameLost:
            continue
    raise DeviceTimeout("ten frames in a row arrived damaged")


def _set_mode(camera: Camera, mode: str, value: object) -> None:
    getattr(camera, f"set_{mode}")(value)
    require(getattr(camera, mode) == value, f"{mode} is not {value}")
    check_settings_are_allowed(camera)


def _check_one_frame(camera: Camera) -> None:
    allowed = camera.capabilities
    with _running(camera):
        shape = _next(camera).pixels.shape
        require(shape == (allowed.rows, allowed.columns), f"a frame is {shape}, unlike the capabilities")

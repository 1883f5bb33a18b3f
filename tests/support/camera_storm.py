"""Random commands and faults on a camera: no hang, only `DeviceError`, frames in order, consistent state."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import ClassVar, TypeVar

from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant, precondition, rule

from drivers.camera import Camera, Region
from drivers.errors import REFUSALS, BadValue, DeviceError, DeviceTimeout, Disconnected, FrameLost, WrongState
from support.storm import Storm

T = TypeVar("T")


class CameraStorm(Storm):
    """A subclass also supplies the device's clock, so that a busy computer does not look like a slow call."""

    longest_s: ClassVar[float] = 5.0  # of one call, beyond its own timeout
    camera: Camera | None = None
    last_index: int = -1
    is_started: bool = False

    def open(self) -> Camera:
        """Open the driver over `self.device`."""
        raise NotImplementedError

    def now(self) -> float:
        """Time in seconds on the clock of driver and device."""
        raise NotImplementedError

    @initialize(is_started=st.booleans())
    def begin(self, *, is_started: bool) -> None:
        self.device = self.make()
        self.enter(self.open(), is_started=is_started)

    def enter(self, camera: Camera, *, is_started: bool) -> None:
        """Continue with a newly opened camera, started or not; unstarted ones alone would hardly read a frame."""
        self.camera, self.is_started, self.last_index = camera, False, -1
        if is_started:
            self.start()

    def call(self, action: Callable[[Camera], T]) -> T | None:
        """Return the result of the action, or None after a `DeviceError`."""
        assert self.camera is not None
        try:
            with self.in_time():
                return action(self.camera)
        except Disconnected:
            assert self.camera.state == "lost"
            return None
        except DeviceError:
            return None

    @contextmanager
    def in_time(self, timeout_s: float = 0.0) -> Iterator[None]:
        """Assert that the block takes no longer than allowed."""
        start_s = self.now()
        try:
            yield
        finally:
            assert self.now() - start_s < self.longest_s + timeout_s

    @precondition(lambda self: self.camera is not None)
    @rule()
    def start(self) -> None:
        assert self.camera is not None
        try:
            with self.in_time():
                self.camera.start()
        except WrongState:
            assert self.is_started
        except DeviceError:
            return
        else:
            assert not self.is_started
            self.is_started, self.last_index = True, -1

    @precondition(lambda self: self.camera is not None)
    @rule()
    def stop(self) -> None:
        def action(camera: Camera) -> bool:
            camera.stop()
            return True

        if self.call(action):
            self.is_started = False

    @precondition(lambda self: self.camera is not None)
    @rule(timeout_s=st.sampled_from([0.0, 0.02, 0.2, float("nan"), -1.0, float("inf")]), count=st.integers(1, 3))
    def read(self, timeout_s: float, count: int) -> None:
        assert self.camera is not None
        for _ in range(count):
            try:
                with self.in_time(timeout_s if 0 <= timeout_s < float("inf") else 0.0):
                    frame = self.camera.read(timeout_s)
            except BadValue:
                assert not 0 <= timeout_s < float("inf")
            except WrongState:
                assert not self.is_started
            except (DeviceTimeout, FrameLost):
                assert self.is_started
            except DeviceError:
                return
            else:
                assert self.is_started
                assert frame.index > self.last_index
                assert frame.pixels.ndim == 2
                assert not frame.pixels.flags.writeable
                self.last_index = frame.index

    @precondition(lambda self: self.camera is not None)
    @rule(part=st.floats(-0.1, 1.1) | st.just(float("nan")))
    def set_exposure(self, part: float) -> None:
        def action(camera: Camera) -> bool:
            allowed = camera.capabilities.exposure_range_s
            longest_s = min(allowed.maximum, allowed.minimum + 0.5)
            before_s, wanted_s = camera.exposure_s, allowed.minimum + part * (longest_s - allowed.minimum)
            try:
                taken_s = camera.set_exposure(wanted_s)
            except REFUSALS:
                assert camera.exposure_s == before_s
                return False
            assert camera.exposure_s == taken_s
            return True

        self.call(action)

    @precondition(lambda self: self.camera is not None)
    @rule(part=st.floats(-0.1, 1.1) | st.just(float("nan")))
    def set_gain(self, part: float) -> None:
        def action(camera: Camera) -> None:
            allowed = camera.capabilities.em_gain_range
            before = camera.em_gain
            try:
                taken = camera.set_em_gain(allowed.minimum + part * (allowed.maximum - allowed.minimum))
            except REFUSALS:
                assert camera.em_gain == before
            else:
                assert camera.em_gain == taken

        self.call(action)

    @precondition(lambda self: self.camera is not None)
    @rule(what=st.sampled_from(["amplifier", "readout_speed", "binning", "trigger"]), choice=st.integers(0, 4))
    def set_mode(self, what: str, choice: int) -> None:
        def action(camera: Camera) -> None:
            values = getattr(camera.capabilities, f"{what}s")
            before, wanted = getattr(camera, what), values[choice] if choice < len(values) else 99
            if what == "trigger" and wanted != "internal":
                return  # no external trigger would come
            try:
                getattr(camera, f"set_{what}")(wanted)
            except REFUSALS:
                assert getattr(camera, what) == before
            else:
                assert getattr(camera, what) == wanted
                assert not self.is_started

        self.call(action)

    @precondition(lambda self: self.camera is not None)
    @rule(data=st.data())
    def set_region(self, data: st.DataObject) -> None:
        steps = data.draw(st.tuples(*[st.integers(-1, 40)] * 4))

        def action(camera: Camera) -> None:
            step_px, before = camera.capabilities.region_step_px, camera.region
            top, left, rows, columns = (step * step_px for step in steps)
            try:
                taken = camera.set_region(Region(top, left, rows, columns))
            except REFUSALS:
                assert camera.region == before
            else:
                assert camera.region == taken

        self.call(action)

    @precondition(lambda self: self.camera is not None)
    @rule()
    def ask(self) -> None:
        def action(camera: Camera) -> None:
            allowed = camera.capabilities
            allowed.exposure_range_s.check(camera.exposure_s, "exposure_s")
            allowed.em_gain_range.check(camera.em_gain, "em_gain")
            assert camera.amplifier in allowed.amplifiers
            assert camera.readout_speed in allowed.readout_speeds
            assert camera.properties()["name"] == camera.name

        self.call(action)

    @rule(data=st.data())
    def fault(self, data: st.DataObject) -> None:
        self.happen(data.draw(self.faults()))

    @precondition(lambda self: self.camera is not None)
    @rule()
    def close(self) -> None:
        assert self.camera is not None
        with suppress(DeviceError):
            self.camera.close()
        self.camera.close()
        assert self.camera.state == "closed"
        self.camera = None

    @precondition(lambda self: self.camera is None)
    @rule(is_repaired=st.booleans(), is_started=st.booleans())
    def reopen(self, *, is_repaired: bool, is_started: bool) -> None:
        if is_repaired:
            self.recover()
        try:
            camera = self.open()
        except DeviceError:  # can depend on time on a real wire, and must not decide the next step
            assert not is_repaired
            self.recover()
            camera = self.open()
        self.enter(camera, is_started=is_started)

    @invariant()
    def state_fits(self) -> None:
        if self.camera is not None:
            state = self.camera.state
            assert state in {"running" if self.is_started else "stopped", "lost"}

    def teardown(self) -> None:
        super().teardown()
        if self.camera is not None:
            with suppress(DeviceError):
                self.camera.close()

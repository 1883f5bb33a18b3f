"""Routines restore the devices, or turn the light off after a fault, at whichever call they end."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from scipy import special

from app.acquisition.devices import simulated_bench
from app.bench.config import load_bench
from app.measurement.auto_exposure import auto_expose
from app.measurement.averages import (
    Average,
    BackgroundCheck,
    average,
    check_background,
    compare_backgrounds,
    take_dark,
    take_reference,
)
from app.measurement.routines import NO_CALLBACKS, Cancelled, RoutineCallbacks, RoutineError
from drivers.interface import (
    BadValue,
    Camera,
    Device,
    DeviceError,
    Devices,
    DeviceTimeout,
    Disconnected,
    Frame,
    LightSource,
    Stage,
    WrongState,
)
from simulated_devices.bench import SimulatedLight, SimulatedStage
from simulated_devices.camera import SimulatedCamera
from simulated_devices.clock import ManualClock

PITCH_PX = 31.25
EXPOSURE_S = 0.03
RIGHT_CURRENT_A = 0.35


@dataclass(frozen=True)
class State:
    """State of the devices."""

    is_light_on: bool
    is_sample_in: bool
    is_running: bool
    exposure_s: float = EXPOSURE_S
    current_a: float = RIGHT_CURRENT_A

    @classmethod
    def of(cls, devices: Devices) -> State:
        camera, light, stage = devices.camera, devices.light, devices.stage
        return cls(light.is_on, stage.is_sample_in, camera.is_running, camera.exposure_s, light.current_a)

    def set(self, devices: Devices) -> None:
        camera = devices.camera
        camera.stop()
        camera.set_exposure(self.exposure_s)
        devices.light.set_current(self.current_a)
        devices.light.set_on(self.is_light_on)
        devices.stage.set_sample_in(self.is_sample_in)
        if self.is_running:
            camera.start()


LIVE, AT_REST = State(True, True, True), State(False, False, False)


class Counter:
    """Counts calls of devices, and runs a function at one of them."""

    def __init__(self, at: int = -1, then: Callable[[], None] = lambda: None) -> None:
        self.calls, self.at, self.then = 0, at, then

    def __call__(self) -> None:
        self.calls += 1
        if self.calls == self.at:
            self.then()

    def is_past(self) -> bool:
        return self.calls >= self.at


class Counted:
    """Proxy of a device that counts its calls."""

    def __init__(self, device: Device, counter: Counter) -> None:
        self._device, self._counter = device, counter

    def __getattr__(self, name: str) -> object:
        if not callable(getattr(type(self._device), name)):
            self._counter()
            return getattr(self._device, name)

        def call(*arguments: object) -> object:
            self._counter()
            return getattr(self._device, name)(*arguments)

        return call


def counted(devices: Devices, counter: Counter) -> Devices:
    return Devices(
        cast("Camera", Counted(devices.camera, counter)),
        cast("LightSource", Counted(devices.light, counter)),
        cast("Stage", Counted(devices.stage, counter)),
    )


BEFORE = Average(
    np.full((172, 240), 500, np.float32),
    np.full((172, 240), 40, np.float32),
    4,
    EXPOSURE_S,
    em_gain=8.0,
    amplifier="em",
)
Routine = Callable[[Devices, Callable[[], bool]], object]


def dark(devices: Devices, should_stop: Callable[[], bool]) -> object:
    return take_dark(devices, 2, RoutineCallbacks(should_stop=should_stop))


def reference(devices: Devices, should_stop: Callable[[], bool]) -> object:
    return take_reference(devices, 2, RoutineCallbacks(should_stop=should_stop))


def exposure(devices: Devices, should_stop: Callable[[], bool]) -> object:
    return auto_expose(devices, PITCH_PX, RoutineCallbacks(should_stop=should_stop))


def background(devices: Devices, should_stop: Callable[[], bool]) -> object:
    return check_background(devices, BEFORE, 2, RoutineCallbacks(should_stop=should_stop))


ROUTINES: dict[str, Routine] = {"dark": dark, "reference": reference, "exposure": exposure, "background": background}


@pytest.fixture(scope="module")
def devices(small_toml: Path) -> Iterator[Devices]:
    clock = ManualClock()
    settings = load_bench(small_toml, ("camera.readout_speed=2", f"camera.exposure_s={EXPOSURE_S}"))
    bench = simulated_bench(settings, lambda _: None, clock)
    with SimulatedCamera(bench) as camera, SimulatedStage(bench) as stage, SimulatedLight(bench) as light:
        yield Devices(camera, light, stage)
    bench.close()


def never() -> bool:
    return False


def calls_of(routine: Routine, devices: Devices, state: State) -> int:
    state.set(devices)
    counter = Counter()
    routine(counted(devices, counter), never)
    return counter.calls


@pytest.mark.parametrize("state", [LIVE, AT_REST], ids=["live", "at rest"])
@pytest.mark.parametrize("name", ROUTINES)
def test_routine_restores_devices(devices: Devices, name: str, state: State) -> None:
    state.set(devices)
    ROUTINES[name](devices, never)
    left = State.of(devices)
    assert (left.is_light_on, left.is_sample_in, left.is_running) == (
        state.is_light_on,
        state.is_sample_in,
        state.is_running,
    )
    assert name == "exposure" or left == state


def test_averages_set_light_and_sample(devices: Devices) -> None:
    seen: set[tuple[bool, bool]] = set()

    def note(*_: object) -> None:
        seen.add((devices.light.is_on, devices.stage.is_sample_in))

    for take, is_light_on in ((take_dark, False), (take_reference, True)):
        LIVE.set(devices)
        seen.clear()
        take(devices, 2, RoutineCallbacks(note))
        assert seen == {(is_light_on, not is_light_on)}  # a dark does not move the sample


@pytest.mark.parametrize("state", [LIVE, AT_REST], ids=["live", "at rest"])
@pytest.mark.parametrize("name", ROUTINES)
def test_cancelling_at_any_call_restores_devices(devices: Devices, name: str, state: State) -> None:
    calls = calls_of(ROUTINES[name], devices, state)
    assert calls > 15
    cancelled = 0
    for at in range(calls + 1):
        state.set(devices)
        counter = Counter(at)
        try:
            ROUTINES[name](counted(devices, counter), counter.is_past)
        except Cancelled:
            cancelled += 1
            assert State.of(devices) == state
    assert cancelled > calls / 3  # the others came after the last frame


@pytest.mark.parametrize("name", ["reference", "exposure"])
def test_light_that_goes_off_amid_a_routine_ends_it(
    devices: Devices, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def go_off() -> bool:
        devices.light._switch(on=False)
        return False

    LIVE.set(devices)
    monkeypatch.setattr(devices.light, "off_reason", "the light went off")
    with pytest.raises(RoutineError, match=r"the light went off: switch it on \(L\) and repeat"):
        ROUTINES[name](devices, go_off)


@pytest.mark.parametrize("state", [LIVE, AT_REST], ids=["live", "at rest"])
@pytest.mark.parametrize("fault", [Disconnected, DeviceTimeout])
@pytest.mark.parametrize("name", ROUTINES)
def test_device_fault_at_any_call_turns_light_off(
    devices: Devices, name: str, fault: type[DeviceError], state: State
) -> None:
    calls, survived = calls_of(ROUTINES[name], devices, state), 0

    def fail() -> None:
        raise fault("pulled")

    for at in range(1, calls + 1):
        state.set(devices)
        try:
            ROUTINES[name](counted(devices, Counter(at, fail)), never)
        except fault:
            assert not devices.light.is_on
        else:
            survived += 1  # a timeout of one wait slice is retried
    assert survived <= (calls / 2 if fault is DeviceTimeout else 0)


@pytest.mark.parametrize("refusal", [BadValue, WrongState, RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("name", ROUTINES)
def test_refusal_at_any_call_restores_devices_or_darkens(
    devices: Devices, name: str, refusal: type[BaseException]
) -> None:
    calls, restored = calls_of(ROUTINES[name], devices, LIVE), 0

    def refuse() -> None:
        raise refusal

    for at in range(1, calls + 1):
        LIVE.set(devices)
        with pytest.raises(refusal):
            ROUTINES[name](counted(devices, Counter(at, refuse)), never)
        restored += (left := State.of(devices)) == LIVE
        assert left == LIVE or not left.is_light_on
    assert restored > calls / 4  # a refusal during the restoration leaves them dark


@pytest.mark.parametrize("frames", [0, -1])
def test_average_needs_at_least_one_frame(devices: Devices, frames: int) -> None:
    LIVE.set(devices)
    for take in (take_dark, take_reference):
        with pytest.raises(BadValue, match=r"cannot be averaged"):
            take(devices, frames, NO_CALLBACKS)
    assert State.of(devices) == LIVE


class Played:
    """Camera that plays given frames."""

    exposure_s, em_gain, amplifier = 0.1, 1.0, "normal"

    def __init__(self, frames: np.ndarray) -> None:
        self._frames = iter(frames)
        self.capabilities = type("Size", (), {"rows": frames.shape[1], "columns": frames.shape[2]})

    def start(self) -> None:
        """Do nothing."""

    stop = start

    def read(self, _timeout_s: float) -> Frame:
        return Frame(
            pixels=next(self._frames), index=0, camera_time_s=0.0, host_time_s=0.0, exposure_s=0.1, em_gain=1.0
        )


@pytest.mark.parametrize("frames", [1, 2, 50])
def test_mean_and_variance_match_numpy(frames: int) -> None:
    random = np.random.default_rng(3)
    stack = (50_000 + random.integers(-3, 4, (frames, 4, 5))).astype(np.uint16)
    made = average(cast("Camera", Played(stack)), frames, NO_CALLBACKS)
    np.testing.assert_allclose(made.mean, stack.mean(axis=0), rtol=1e-7)
    expected = stack.astype(np.float64).var(axis=0, ddof=1) if frames > 1 else np.zeros((4, 5))
    np.testing.assert_allclose(made.variance, expected, rtol=1e-6, atol=1e-9)
    assert made.mean.dtype == made.variance.dtype == np.float32
    assert made.frames == frames


def dark_like(frames: int, random: np.random.Generator, drift: float = 0.0, jitter: float = 0.0) -> np.ndarray:
    """Dark frames (frame, row, column), counts, with a noise of 6 counts."""
    level = 500 + drift + jitter * random.standard_normal((frames, 1, 1))
    return np.asarray(np.rint(level + 6 * random.standard_normal((frames, 90, 110))))


def compared(before: np.ndarray, now: np.ndarray) -> BackgroundCheck:
    def averaged(stack: np.ndarray) -> Average:
        variance = stack.var(axis=0, ddof=1) if len(stack) > 1 else np.zeros(stack.shape[1:])
        return Average(stack.mean(axis=0, dtype=np.float32), variance.astype(np.float32), len(stack), 0.1, 1.0, "em")

    return compare_backgrounds(averaged(before), averaged(now), [float(frame.mean()) for frame in now])


def test_error_of_a_drift_is_that_of_a_median_or_of_the_frames() -> None:
    """Normal pixels of 6 counts: the median of n has the standard error sqrt(pi / 2 n) times 6."""
    shape, variance = (60, 70), np.full((60, 70), 36, np.float32)
    dark = Average(np.full(shape, 500, np.float32), variance, 20, 0.1, 1.0, "em")
    mean = np.full(shape, 700, np.float32)
    mean[3, 4] = 550  # hot in the dark: brighter than before, but less so than the others
    now = Average(mean, variance, 2, 0.1, 1.0, "em")
    averaged = np.sqrt(1 / 20 + 1 / 2)
    steady, unsteady = compare_backgrounds(dark, now, [700.0, 700.0]), compare_backgrounds(dark, now, [699.0, 701.0])
    assert steady.drift_error_counts == pytest.approx(averaged * 6 * np.sqrt(np.pi / 2 / 4200))
    assert unsteady.drift_error_counts == pytest.approx(averaged * np.sqrt(2))
    assert (steady.drift_counts, steady.hot_pixels, steady.cooled_pixels) == (200, 0, 1)


@pytest.mark.parametrize("now_frames", [2, 8])
@pytest.mark.parametrize("before_frames", [1, 4, 20])
def test_background_check_detects_drift(before_frames: int, now_frames: int) -> None:
    random = np.random.default_rng(before_frames * 100 + now_frames)
    before = dark_like(before_frames, random)
    for _ in range(5):
        check = compared(before, dark_like(now_frames, random))
        assert check.is_good
        assert check.verdict.startswith("the dark is still good")
        assert check.noise_counts == pytest.approx(6, rel=0.05)
        assert abs(check.drift_counts) < 0.5
    check = compared(before, dark_like(now_frames, random, drift=-3.0))
    assert check.drift_counts == pytest.approx(-3, abs=0.5)
    assert (check.is_good, check.hot_pixels, check.cooled_pixels) == (False, 0, 0)
    assert "drift -" in check.verdict
    assert "take the dark again" in check.verdict


def test_frame_to_frame_jitter_is_no_drift() -> None:
    random = np.random.default_rng(5)
    significance = [
        compared(dark_like(20, random, jitter=2.0)[:, :30], dark_like(8, random, jitter=2.0)[:, :30]).significance
        for _ in range(60)
    ]
    # median of |t| of Student's distribution with seven degrees of freedom
    assert np.median(significance) == pytest.approx(special.stdtrit(7, 0.75), rel=0.3)
    assert np.mean(np.array(significance) > 5) < 0.02


def test_new_hot_and_cooled_pixels_are_counted() -> None:
    random = np.random.default_rng(6)
    before, now = dark_like(20, random), dark_like(8, random)
    now[:, 3, 4] += 200
    now[:, 50, 60] += 60
    before[:, 20, 20] += 5000
    steady = 3000 + 60 * random.standard_normal((28, 1))  # hot before and after, and noisier
    before[:, 70, 70], now[:, 70, 70] = steady[:20, 0], steady[20:, 0]
    check = compared(before, now)
    assert (check.hot_pixels, check.cooled_pixels, check.is_good) == (2, 1, False)
    assert "2 new hot pixels, 1 no longer hot" in check.verdict

"""Auto-exposure: found within six frames from any start, or a reason why it is impossible."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from app.acquisition.devices import simulated_bench
from app.bench.config import load_bench
from app.measurement.auto_exposure import AutoExposure, auto_expose
from app.measurement.routines import NO_CALLBACKS, Cancelled, RoutineCallbacks, RoutineError
from drivers.interface import BadValue, CameraCapabilities, Devices, Frame, Range
from simulated_devices.bench import SimulatedLight, SimulatedStage
from simulated_devices.camera import SimulatedCamera
from simulated_devices.clock import ManualClock
from studies.exposure_bench import PITCH_PX, LampScene, ManyFramesCamera, exposure_bench, spots, squares

FULL_SCALE = 65535
C9100 = {  # the property sheet's exposures: EM amplifier at speed 3 and 2, normal amplifier
    "em3": Range(0.0139, 1.0),
    "em2": Range(0.02713, 7200.0),
    "normal": Range(0.42147, 7200.0),
}
WIDEST = Range(1e-5, 7200.0)
IMAGES = {"squares": squares(), "broad": squares(width_px=13.0), "haze": squares(background=0.2), "spots": spots()}


def expose(devices: Devices, fill: float = 0.7) -> AutoExposure:
    return auto_expose(devices, PITCH_PX, NO_CALLBACKS, fill=fill)


def true_fill(scene: LampScene, found: AutoExposure) -> float:
    """Fill of the brightest pixel without noise."""
    light = scene.counts_per_a_s * found.current_a**scene.droop * found.exposure_s * float(scene.image.max())
    return float((light + scene.offset_counts) / (2**scene.bits - 1))


@pytest.mark.slow
@settings(max_examples=120, deadline=None, derandomize=True)
@given(
    allowed=st.sampled_from([*C9100.values(), WIDEST]),
    right=st.floats(0, 1),
    start=st.sampled_from([0.0, 1.0]) | st.floats(0, 1),
    current_a=st.sampled_from([0.0, 0.001, 0.35, 1.0]),
    image=st.sampled_from(sorted(IMAGES)),
    noise=st.sampled_from([1.5, 6.4, 40.0]),
    is_on=st.booleans(),
    seed=st.integers(0, 10**6),
)
@example(allowed=WIDEST, right=0.0, start=1.0, current_a=0.35, image="squares", noise=6.4, is_on=True, seed=1)
@example(allowed=WIDEST, right=1.0, start=0.0, current_a=0.35, image="spots", noise=40.0, is_on=False, seed=1)
@example(allowed=WIDEST, right=0.999, start=1.0, current_a=0.35, image="spots", noise=40.0, is_on=False, seed=1)
@example(allowed=WIDEST, right=0.5, start=1.0, current_a=0.0, image="broad", noise=40.0, is_on=False, seed=1)
def test_exposure_is_found_within_six_frames(
    *, allowed: Range, right: float, start: float, current_a: float, image: str, noise: float, is_on: bool, seed: int
) -> None:
    def exposure_s(part: float) -> float:
        return float(allowed.minimum ** (1 - part) * allowed.maximum**part)

    scene = LampScene(
        counts_per_a_s=45_000 / (0.35 * exposure_s(right)),
        exposure_range_s=allowed,
        image=IMAGES[image],
        read_noise_counts=noise,
        seed=seed,
    )
    begin_s = min(max(exposure_s(start), allowed.minimum), allowed.maximum)
    devices, camera, lamp = exposure_bench(scene, exposure_s=begin_s, current_a=current_a, is_on=is_on)
    found = expose(devices)
    assert found.frames == len(camera.exposed_s) <= 6
    assert found.fill == pytest.approx(0.7, abs=0.05)
    assert true_fill(scene, found) == pytest.approx(0.7, abs=0.06)  # noise adds little to the brightest pixel
    assert (found.exposure_s, found.current_a) == (camera.exposure_s, lamp.current_a)
    assert lamp.is_on is is_on
    assert not camera.is_running


def test_full_scale_may_follow_from_the_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera with 12 bits in Mono16 shows with its first frame that 4095 is the most."""
    known = ManyFramesCamera.capabilities

    def shown(camera: ManyFramesCamera) -> CameraCapabilities:
        allowed: CameraCapabilities = known.__get__(camera)
        return allowed if camera.exposed_s else replace(allowed, full_scale=FULL_SCALE)

    monkeypatch.setattr(ManyFramesCamera, "capabilities", property(shown))
    scene = LampScene(counts_per_a_s=2800 / (0.35 * 0.15), exposure_range_s=C9100["em3"], bits=12)
    found = expose(exposure_bench(scene, exposure_s=0.05)[0])
    assert found.fill == pytest.approx(0.7, abs=0.05)
    assert true_fill(scene, found) == pytest.approx(0.7, abs=0.06)


def test_current_changes_only_if_exposure_is_not_enough() -> None:
    for right_s, begin_s in [(0.2, 1.0), (0.2, 0.0139)]:
        scene = LampScene(counts_per_a_s=45_000 / (0.35 * right_s), exposure_range_s=C9100["em3"])
        assert expose(exposure_bench(scene, exposure_s=begin_s)[0]).current_a == 0.35
    scene = LampScene(counts_per_a_s=45_000 / (0.35 * 0.0014), exposure_range_s=C9100["em3"])
    found = expose(exposure_bench(scene, exposure_s=0.1)[0])
    assert found.exposure_s == pytest.approx(0.0139)
    assert found.current_a == pytest.approx(0.035, rel=0.1)
    scene = LampScene(counts_per_a_s=45_000 / (0.35 * 2.0), exposure_range_s=C9100["em3"])
    found = expose(exposure_bench(scene, exposure_s=0.1)[0])
    assert found.exposure_s == pytest.approx(1.0)
    assert found.current_a == pytest.approx(0.7, rel=0.1)


def test_auto_exposure_succeeds_with_drooping_or_flickering_light() -> None:
    for scene in (
        LampScene(counts_per_a_s=45_000 / 0.001, exposure_range_s=C9100["em3"], droop=0.8),
        LampScene(counts_per_a_s=45_000 / 0.05, exposure_range_s=C9100["em3"], flicker=0.01),
    ):
        assert expose(exposure_bench(scene, exposure_s=1.0)[0]).frames <= 6


def test_hot_pixels_in_ten_percent_of_lenslets_are_ignored() -> None:
    for seed in range(8):
        scene = LampScene(counts_per_a_s=45_000 / 0.05, exposure_range_s=C9100["em3"], hot_pixels=10, seed=seed)
        assert true_fill(scene, expose(exposure_bench(scene, exposure_s=1.0)[0])) == pytest.approx(0.7, abs=0.06)


def test_light_without_subimages_raises() -> None:
    scene = LampScene(counts_per_a_s=0.0, exposure_range_s=C9100["em3"], ambient_counts_per_s=4.5e5)
    devices, camera, lamp = exposure_bench(scene, exposure_s=0.1)
    with pytest.raises(RoutineError, match="no subimages"):
        expose(devices)
    assert (camera.exposure_s, lamp.is_on) == (0.1, False)


def test_auto_exposure_succeeds_with_8_bits() -> None:
    eight = LampScene(
        counts_per_a_s=175 / 0.05,
        exposure_range_s=C9100["em3"],
        bits=8,
        offset_counts=4.0,
        read_noise_counts=0.8,
        counts_per_electron=0.02,
    )
    for begin_s in (0.0139, 1.0):
        assert expose(exposure_bench(eight, exposure_s=begin_s)[0]).frames <= 6


@pytest.mark.parametrize("begin_s", [0.0139, 1.0])
@pytest.mark.parametrize("is_on", [True, False])
@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        (LampScene(counts_per_a_s=0.0, exposure_range_s=C9100["em3"]), "no light detected, even at .*: check the lamp"),
        (
            LampScene(counts_per_a_s=9_000, exposure_range_s=C9100["em3"]),
            "(too little light: .* (4.9|5) times as much|no light detected)",
        ),
        (LampScene(counts_per_a_s=1e12, exposure_range_s=C9100["em3"]), "too bright even at the shortest.* filter"),
        (LampScene(counts_per_a_s=1e6, exposure_range_s=C9100["em3"], well_counts=30_000), "fill 47% .* do not follow"),
        (
            LampScene(counts_per_a_s=1e6, exposure_range_s=C9100["em3"], current_range_a=Range(0.0, 0.0)),
            "the allowed current is zero",
        ),
    ],
)
def test_impossible_exposure_raises_and_restores_devices(
    scene: LampScene, sentence: str, begin_s: float, is_on: bool
) -> None:
    current_a = min(0.35, scene.current_range_a.maximum)
    devices, camera, lamp = exposure_bench(scene, exposure_s=begin_s, current_a=current_a, is_on=is_on)
    camera.start()
    with pytest.raises(RoutineError, match=sentence):
        expose(devices)
    assert len(camera.exposed_s) <= 6
    assert camera.exposure_s == pytest.approx(begin_s)
    assert camera.is_running
    assert (lamp.current_a, lamp.is_on) == (current_a, is_on)


def test_missing_light_is_detected_without_long_exposures() -> None:
    scene = LampScene(counts_per_a_s=0.0, exposure_range_s=WIDEST)
    for begin_s in (1e-5, 0.1, 7200.0):
        devices, camera, _ = exposure_bench(scene, exposure_s=begin_s)
        with pytest.raises(RoutineError, match="no light"):
            expose(devices)
        assert sum(camera.exposed_s) < 120


@pytest.mark.parametrize("fill", [math.nan, 0.0, 0.9, 1.0, -1.0])
def test_fill_must_be_within_tolerances(fill: float) -> None:
    devices, camera, _ = exposure_bench(LampScene(counts_per_a_s=1e5, exposure_range_s=WIDEST), exposure_s=0.1)
    with pytest.raises(BadValue, match="fill"):
        expose(devices, fill)
    assert not camera.exposed_s


def test_fill_is_adjustable() -> None:
    scene = LampScene(counts_per_a_s=1e6, exposure_range_s=C9100["em3"])
    assert expose(exposure_bench(scene, exposure_s=0.0139)[0], 0.4).fill == pytest.approx(0.4, abs=0.05)


@pytest.fixture
def simulated(small_toml: Path) -> Iterator[tuple[Devices, ManualClock]]:
    clock = ManualClock()
    settings = load_bench(small_toml, ("camera.readout_speed=2", "camera.exposure_s=0.03"))
    bench = simulated_bench(settings, lambda _: None, clock)
    with SimulatedCamera(bench) as camera, SimulatedStage(bench) as stage, SimulatedLight(bench) as light:
        yield Devices(camera, light, stage), clock
    bench.close()


@pytest.mark.parametrize("begin_s", [0.02713, 0.3, 7200.0])
@pytest.mark.parametrize("em_gain", [1.0, 200.0])
@pytest.mark.parametrize("current_a", [0.0, 0.35])
def test_auto_exposure_succeeds_on_simulated_bench(
    simulated: tuple[Devices, ManualClock], begin_s: float, em_gain: float, current_a: float
) -> None:
    devices, clock = simulated
    devices.camera.set_exposure(begin_s)
    devices.camera.set_em_gain(em_gain)
    devices.light.set_current(current_a)
    shown: list[float] = []

    def progress(frame: Frame, fraction: float) -> None:
        assert frame.exposure_s == devices.camera.exposure_s
        shown.append(fraction)

    begun_s = clock.now()
    found = auto_expose(devices, 31.25, RoutineCallbacks(progress))
    assert found.frames <= 6
    assert clock.now() - begun_s < 60
    assert shown == sorted(shown)
    assert shown[-1] == 1.0
    assert (devices.camera.em_gain, devices.light.is_on, devices.camera.is_running) == (em_gain, False, False)
    devices.light.set_on(True)
    devices.camera.start()
    pixels = devices.camera.read(found.exposure_s + 1).pixels
    top = np.partition(pixels, -20, axis=None)[-20]
    assert top / FULL_SCALE == pytest.approx(0.7, abs=0.07 if em_gain < 100 else 0.2)
    assert not np.any(pixels == FULL_SCALE)


def test_cancelling_interrupts_long_exposure(simulated: tuple[Devices, ManualClock]) -> None:
    devices, clock = simulated
    devices.camera.set_exposure(100.0)
    with pytest.raises(Cancelled):
        auto_expose(devices, 31.25, RoutineCallbacks(should_stop=lambda: clock.now() > 1.0))
    assert clock.now() < 1.3
    assert devices.camera.exposure_s == 100.0
    assert not devices.light.is_on

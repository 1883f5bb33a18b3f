"""What every camera, light and stage must do, simulated or real: subclass and give the fixture that opens the device.

A real device's tests are the same classes with a fixture that opens it, run on demand.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from drivers.interface import BadValue, Camera, DeviceTimeout, Disconnected, LightSource, Stage, WrongState

GONE = (WrongState, Disconnected)
NAN = float("nan")


class CameraContract:
    """Needs a fixture `camera`, stopped, with a short exposure."""

    def test_has_a_name_and_capabilities(self, camera: Camera) -> None:
        capabilities = camera.capabilities
        assert camera.name
        assert capabilities.rows > 0
        assert capabilities.columns > 0
        assert capabilities.pixel_pitch_m > 0
        assert capabilities.full_scale > 0
        assert camera.amplifier in capabilities.amplifiers
        capabilities.exposure_range_s.check(camera.exposure_s, "exposure_s")
        capabilities.em_gain_range.check(camera.em_gain, "em_gain")

    def test_does_not_run_until_it_is_started(self, camera: Camera) -> None:
        assert not camera.is_running
        with pytest.raises(WrongState):
            camera.read(0.0)

    def test_frames_count_from_zero_and_are_read_only(self, camera: Camera) -> None:
        camera.start()
        assert camera.is_running
        frames = [camera.read(10.0) for _ in range(3)]
        capabilities = camera.capabilities
        assert [frame.index for frame in frames] == [0, 1, 2]
        for frame in frames:
            assert frame.pixels.shape == (capabilities.rows, capabilities.columns)
            assert frame.pixels.dtype == np.uint16
            assert not frame.pixels.flags.writeable
            assert frame.pixels.max() <= capabilities.full_scale
            assert frame.exposure_s == camera.exposure_s
            assert frame.em_gain == camera.em_gain
        assert not np.shares_memory(frames[0].pixels, frames[1].pixels)
        steps = np.diff([frame.camera_time_s for frame in frames])
        assert (steps >= 0.9 * camera.exposure_s).all()

    def test_a_read_that_is_too_early_times_out_and_loses_nothing(self, camera: Camera) -> None:
        camera.start()
        with pytest.raises(DeviceTimeout):
            camera.read(0.0)
        assert camera.read(10.0).index == 0

    def test_a_timeout_must_be_a_time(self, camera: Camera) -> None:
        camera.start()
        for timeout_s in (NAN, -1.0):
            with pytest.raises(BadValue):
                camera.read(timeout_s)

    def test_starts_anew_from_zero(self, camera: Camera) -> None:
        for _ in range(2):
            camera.start()
            assert camera.read(10.0).index == 0
            camera.stop()
        assert not camera.is_running
        with pytest.raises(WrongState):
            camera.read(0.0)

    def test_cannot_be_started_twice_but_stopped_twice(self, camera: Camera) -> None:
        camera.start()
        with pytest.raises(WrongState):
            camera.start()
        camera.stop()
        camera.stop()

    def test_takes_the_exposures_it_allows_and_no_other(self, camera: Camera) -> None:
        allowed = camera.capabilities.exposure_range_s
        for exposure_s in (allowed.minimum, min(allowed.maximum, 2 * allowed.minimum)):
            taken_s = camera.set_exposure(exposure_s)
            assert taken_s == pytest.approx(exposure_s, rel=0.01)
            assert camera.exposure_s == taken_s
        for exposure_s in (0.0, -1.0, NAN, 0.9 * allowed.minimum, 1.1 * allowed.maximum):
            with pytest.raises(BadValue):
                camera.set_exposure(exposure_s)
        assert camera.exposure_s == taken_s

    def test_the_exposure_can_be_changed_while_running(self, camera: Camera) -> None:
        camera.start()
        longer_s = camera.set_exposure(2 * camera.capabilities.exposure_range_s.minimum)
        assert camera.is_running
        frames = [camera.read(10.0) for _ in range(6)]
        assert frames[-1].exposure_s == longer_s

    def test_the_gain_stays_in_its_range(self, camera: Camera) -> None:
        allowed = camera.capabilities.em_gain_range
        assert camera.set_em_gain(allowed.maximum) == camera.em_gain == pytest.approx(allowed.maximum)
        for em_gain in (NAN, allowed.minimum - 1, allowed.maximum + 1):
            with pytest.raises(BadValue):
                camera.set_em_gain(em_gain)

    def test_every_amplifier_can_be_used(self, camera: Camera) -> None:
        for amplifier in camera.capabilities.amplifiers:
            camera.set_amplifier(amplifier)
            assert camera.amplifier == amplifier
            camera.capabilities.exposure_range_s.check(camera.exposure_s, "exposure_s")
            camera.capabilities.em_gain_range.check(camera.em_gain, "em_gain")
        with pytest.raises(BadValue):
            camera.set_amplifier("no such amplifier")

    def test_the_amplifier_cannot_be_changed_while_running(self, camera: Camera) -> None:
        camera.start()
        with pytest.raises(WrongState):
            camera.set_amplifier(camera.amplifier)

    def test_closes_twice_and_is_gone(self, camera: Camera) -> None:
        camera.start()
        camera.close()
        camera.close()
        calls: list[Callable[[], object]] = [
            lambda: camera.capabilities,
            lambda: camera.exposure_s,
            lambda: camera.set_exposure(0.1),
            lambda: camera.amplifier,
            lambda: camera.set_amplifier("normal"),
            lambda: camera.em_gain,
            lambda: camera.set_em_gain(1.0),
            lambda: camera.is_running,
            camera.start,
            camera.stop,
            lambda: camera.read(0.0),
        ]
        for call in calls:
            with pytest.raises(GONE):
                call()


class LightContract:
    """Needs a fixture `light`, just opened."""

    def test_is_off_after_it_was_opened(self, light: LightSource) -> None:
        assert not light.is_on
        assert light.name
        light.current_range_a.check(light.current_a, "current_a")

    def test_can_be_switched(self, light: LightSource) -> None:
        light.set_on(True)
        assert light.is_on
        light.set_on(False)
        assert not light.is_on

    def test_takes_the_currents_it_allows_and_no_other(self, light: LightSource) -> None:
        allowed = light.current_range_a
        half_a = (allowed.minimum + allowed.maximum) / 2
        assert light.set_current(half_a) == light.current_a == pytest.approx(half_a, rel=0.01)
        for current_a in (NAN, allowed.minimum - 0.1, allowed.maximum + 0.1):
            with pytest.raises(BadValue):
                light.set_current(current_a)
        assert light.current_a == pytest.approx(half_a, rel=0.01)

    def test_setting_the_current_does_not_switch_it_on(self, light: LightSource) -> None:
        light.set_current(light.current_range_a.maximum)
        assert not light.is_on

    def test_closes_twice_and_is_gone(self, light: LightSource) -> None:
        light.set_on(True)
        light.close()
        light.close()
        calls: list[Callable[[], object]] = [
            lambda: light.current_range_a,
            lambda: light.current_a,
            lambda: light.set_current(0.0),
            lambda: light.is_on,
            lambda: light.set_on(True),
        ]
        for call in calls:
            with pytest.raises(GONE):
                call()


class StageContract:
    """Needs a fixture `stage`."""

    def test_every_mask_can_be_put_in(self, stage: Stage) -> None:
        assert stage.mask in stage.masks
        for mask in stage.masks:
            stage.set_mask(mask)
            assert stage.mask == mask
        with pytest.raises(BadValue):
            stage.set_mask("no such mask")

    def test_the_sample_goes_in_and_out(self, stage: Stage) -> None:
        for sample_in in (True, False, True):
            stage.set_sample_in(sample_in)
            assert stage.is_sample_in is sample_in

    def test_closes_twice_and_is_gone(self, stage: Stage) -> None:
        stage.close()
        stage.close()
        calls: list[Callable[[], object]] = [
            lambda: stage.masks,
            lambda: stage.mask,
            lambda: stage.set_mask("square"),
            lambda: stage.is_sample_in,
            lambda: stage.set_sample_in(True),
        ]
        for call in calls:
            with pytest.raises(GONE):
                call()

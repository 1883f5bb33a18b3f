"""The bench of auto-exposure studies keeps the contract of devices."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from support.stage_contract import StageContract

from drivers.contract import camera as of_cameras
from drivers.contract import light as of_lights
from drivers.interface import Camera, LightSource, Range, Stage
from studies.exposure_bench import LampScene, exposure_bench

SCENE = LampScene(counts_per_a_s=1e6, exposure_range_s=Range(1e-3, 1.0))


@pytest.mark.parametrize("check", [*of_cameras.CAMERA_CHECKS, of_cameras.check_closes])
def test_camera_keeps_the_contract(check: Callable[[Camera], None]) -> None:
    check(exposure_bench(SCENE, exposure_s=0.1)[1])


@pytest.mark.parametrize(
    "check", [of_lights.check_identity, of_lights.check_switches, of_lights.check_currents, of_lights.check_closes]
)
def test_lamp_keeps_the_contract(check: Callable[[LightSource], None]) -> None:
    check(exposure_bench(SCENE, exposure_s=0.1)[2])


class TestDrawnStage(StageContract):
    @pytest.fixture
    def stage(self) -> Stage:
        return exposure_bench(SCENE, exposure_s=0.1)[0].stage

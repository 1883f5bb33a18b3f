"""Every number that a device's settings take has an upper limit, which stops typing errors before the device opens."""

from __future__ import annotations

import math
from dataclasses import is_dataclass
from typing import get_args

import pytest

from app.bench.device_kinds import DRIVERS
from reconstruction.annotated_settings import Limit, SettingError, check, settings_of
from simulated_devices.settings import SimulatedCameraSettings, SimulatedLightSettings

KINDS = [kind.settings for kinds in DRIVERS.values() for kind in kinds.values()]


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_have_an_upper_limit(kind: type) -> None:
    assert is_dataclass(kind)
    for setting in settings_of(kind):
        if {setting.kind, *get_args(setting.kind)} & {int, float} and isinstance(limit := setting.limit(kind), Limit):
            assert limit.choices or (limit.le is not None and math.isfinite(limit.le)), setting.name


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (lambda: SimulatedCameraSettings(em_gain=301.0, maximum_em_gain=300.0), "1 ... 300 (maximum_em_gain)"),
        (lambda: SimulatedLightSettings(current_a=3.0, maximum_current_a=2.0), "0 ... 2 A (maximum_current_a)"),
    ],
)
def test_limit_of_another_setting_is_told_as_a_number(settings: type, sentence: str) -> None:
    with pytest.raises(SettingError) as told:
        check(settings())
    assert str(told.value).endswith(f"must be {sentence}")

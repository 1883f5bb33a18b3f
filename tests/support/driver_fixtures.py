"""Fixtures of the driver tests: a manual clock, a light closed at the end, a lamp and a DCAM camera, both stand-ins."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from drivers.dcam.camera import DcamCamera
from drivers.interface import DeviceError, LightSource
from simulated_devices.clock import ManualClock
from support.dcam_tools import dcam_stand_in, open_camera
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.dcam.stand_in import StandIn
from support.stand_ins.pseudo_terminal import PtyServer


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def light(reopen: Callable[[], LightSource]) -> Iterator[LightSource]:
    light = reopen()
    yield light
    with suppress(DeviceError):
        light.close()


@pytest.fixture
def lamp() -> DC4100Wire:
    return DC4100Wire()


@pytest.fixture
def lamp_port(lamp: DC4100Wire) -> Iterator[PtyServer]:
    with PtyServer(lamp) as server:
        yield server


@pytest.fixture
def stand_in() -> Iterator[StandIn]:
    with dcam_stand_in() as stand_in:
        yield stand_in


@pytest.fixture
def camera(stand_in: StandIn) -> Iterator[DcamCamera]:
    with open_camera(stand_in) as camera:
        yield camera

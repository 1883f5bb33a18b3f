"""Hours of DCAM capture in a minute, with every frame number accounted for.

`SVWFS_HOURS=10 SVWFS_PIXELS=512 pytest tests/drivers/dcam/test_dcam_long_run.py` runs ten hours of camera time.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from dataclasses import dataclass, field
from random import Random

import numpy as np
import pytest
from support.dcam_tools import dcam_stand_in, library, open_camera
from support.wires.dcam.stand_in import StandIn, pattern

from drivers.dcam import DcamSettings
from drivers.dcam.camera import DcamCamera
from drivers.interface import DeviceTimeout, Frame, FrameLost, Region

PERIOD_S = 0.01429  # 70 frames/s
RING = 128
INVALIDIMAGE = 0x80000321
PIXELS = int(os.environ.get("SVWFS_PIXELS", "48"))
REGION = Region(0, 0, PIXELS, PIXELS)


@dataclass
class Tally:
    """Record of the frames read, and of the cause of each gap."""

    read: int = 0
    next_index: int = 0
    missing: Counter[str] = field(default_factory=Counter)

    def take(self, frame: Frame, because: str = "") -> None:
        """Count a frame; a gap before it must have a known cause."""
        gap = frame.index - self.next_index
        assert gap >= 0
        assert bool(gap) is bool(because), f"{gap} frames are missing before {frame.index} {because}"
        self.missing[because] += gap
        self.next_index = frame.index + 1
        self.read += 1
        number = int(frame.pixels[-1, 0]) + (int(frame.pixels[-1, 1]) << 16)
        assert frame.index == number  # the camera's number, from the last row
        if frame.index % 101 == 0 or because:
            np.testing.assert_array_equal(frame.pixels, pattern(number, REGION))


def happen(dice: Random, stand_in: StandIn, camera: DcamCamera, tally: Tally) -> None:
    """Cause one fault of known size."""
    match dice.choice(("late", "overrun", "lost", "damaged")):
        case "late":  # a short stall of the program
            stand_in.advance(dice.uniform(0, (RING - 2) * PERIOD_S))
        case "overrun":
            before = tally.next_index
            frames = dice.randint(RING + 1, 4 * RING)
            stand_in.advance((frames + 0.5) * PERIOD_S - (stand_in.now() % PERIOD_S))
            transferred = int(stand_in.now() / PERIOD_S + 1e-6)
            frame = camera.read(1.0)
            assert frame.index == transferred - RING // 2 > before
            tally.take(frame, "overwritten")
        case "lost":
            catch_up(camera, tally)
            count = dice.randint(1, 50)
            stand_in.lose(count)
            frame = camera.read(5.0)
            assert frame.index - tally.next_index == count
            tally.take(frame, "lost on the way")
        case "damaged":
            stand_in.fail("dcambuf_copyframe", INVALIDIMAGE)
            with pytest.raises(FrameLost):
                camera.read(1.0)
            frame = camera.read(1.0)
            assert frame.index == tally.next_index + 1
            tally.take(frame, "damaged")


def catch_up(camera: DcamCamera, tally: Tally) -> None:
    """Read all waiting frames."""
    while True:
        try:
            frame = camera.read(0.0)
        except DeviceTimeout:
            return
        tally.take(frame)


def test_long_run_accounts_for_every_frame() -> None:
    duration_s = 3600 * float(os.environ.get("SVWFS_HOURS", "0.05"))
    dice = Random(7)  # noqa: S311 - mishaps, no secrets
    tally = Tally()
    start_s = time.perf_counter()
    with (
        dcam_stand_in() as stand_in,
        open_camera(stand_in, exposure_s=PERIOD_S, ring_frames=RING, region=REGION) as camera,
    ):
        camera.start()
        mishap_s = 0.0
        while stand_in.now() < duration_s:
            frame = camera.read(1.0)
            tally.take(frame)
            assert abs(frame.camera_time_s - (frame.index + 1) * PERIOD_S) < 1e-4
            if stand_in.now() > mishap_s:
                happen(dice, stand_in, camera, tally)
                mishap_s = stand_in.now() + dice.uniform(0.0, 20.0)
        catch_up(camera, tally)
        taken = int(stand_in.now() / PERIOD_S + 0.01)
    assert tally.read + tally.missing.total() == tally.next_index == taken
    assert taken >= duration_s / PERIOD_S
    assert set(tally.missing) - {""} == {"overwritten", "lost on the way", "damaged"}
    print(f"{taken} frames: {tally.read} read, {dict(tally.missing)}, {time.perf_counter() - start_s:.0f} s")  # noqa: T201 - the figures of the run


@pytest.mark.parametrize("speed", [50.0, 2000.0])
def test_frames_keep_pace_with_running_clock(speed: float) -> None:
    """In real time, slower and faster than frames are read, all frames are intact and numbered."""
    tally = Tally()
    with (
        dcam_stand_in(speed) as stand_in,
        DcamCamera(
            DcamSettings(exposure_s=PERIOD_S, ring_frames=RING, region=REGION), library=library(stand_in)
        ) as camera,
    ):
        camera.start()
        while tally.read < 3000:
            frame = camera.read(1.0)
            tally.take(frame, "overwritten" if frame.index != tally.next_index else "")
        assert stand_in.now() >= tally.next_index * PERIOD_S
    assert tally.read + tally.missing.total() == tally.next_index

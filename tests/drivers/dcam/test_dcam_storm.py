"""Random commands and faults through the DCAM driver."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import run_state_machine_as_test
from support.camera_storm import CameraStorm
from support.dcam_tools import dcam_stand_in, open_camera
from support.stand_ins.dcam.stand_in import Plug, StandIn
from support.storm import storm_settings

from drivers.dcam._library import ERRORS, PROTOTYPES, NotThere
from drivers.dcam.camera import DcamCamera
from drivers.interface import BadValue, DeviceError, DeviceTimeout, Disconnected, FrameLost, Region, Unsupported


def codes(*kinds: type[DeviceError]) -> st.SearchStrategy[int]:
    return st.sampled_from([code for code, (_, kind, _) in ERRORS.items() if kind in kinds])


# Wrong errors that each function may return; a wrong state would be believed, so there is none.
ANY = st.tuples(st.sampled_from(sorted(PROTOTYPES)), codes(Disconnected, DeviceTimeout, DeviceError), st.integers(1, 3))
REFUSAL = st.tuples(st.just("dcamprop_setgetvalue"), codes(BadValue, Unsupported, NotThere), st.just(1))
DAMAGE = st.tuples(st.sampled_from(["dcambuf_copyframe", "dcamwait_start"]), codes(FrameLost), st.integers(1, 3))
NO_START = st.tuples(st.sampled_from(["dcambuf_alloc", "dcamcap_start"]), codes(Unsupported, BadValue), st.just(1))
FAILURE = st.tuples(ANY | REFUSAL | DAMAGE | NO_START, st.integers(0, 6)).map(
    lambda drawn: ("fail", *drawn[0], drawn[1])
)


@pytest.mark.slow
@pytest.mark.long
def test_storm_raises_only_device_errors() -> None:
    with dcam_stand_in() as stand_in:

        class Storm(CameraStorm):
            longest_s = 300.0  # reading all properties, at 0.3 s per call

            def now(self) -> float:
                return stand_in.now()

            def make(self) -> StandIn:
                stand_in.reset()
                return stand_in

            def open(self) -> DcamCamera:
                return open_camera(stand_in, ring_frames=8, region=Region(0, 0, 32, 32))

            def faults(self) -> st.SearchStrategy[tuple[Any, ...]]:
                return st.one_of(
                    FAILURE,
                    st.tuples(st.just("slow"), st.sampled_from(sorted(PROTOTYPES)), st.sampled_from([0, 5, 300])),
                    st.tuples(st.just("unplug"), st.sampled_from(Plug), st.floats(0.0, 0.1)),
                    st.tuples(st.just("plug_in")),
                    st.tuples(st.just("lose"), st.integers(1, 20)),
                    st.tuples(st.just("advance"), st.floats(0.0, 1.0)),
                    st.tuples(st.just("stall")),
                )

            def happen(self, fault: tuple[Any, ...]) -> None:
                getattr(stand_in, fault[0])(*fault[1:])

            def recover(self) -> None:
                stand_in.reset()

        run_state_machine_as_test(Storm, settings=storm_settings(40, steps=40))

"""Contract tests for every stage, simulated or real: subclass and supply the fixture `stage`."""

from collections.abc import Callable

import pytest

from drivers.contract import calls, check_properties, require, require_all_raise, require_raises
from drivers.interface import BadValue, Stage, WrongState


def check_masks(stage: Stage) -> None:
    """It accepts every mask that it offers, and no other."""
    check_properties(stage)
    require(stage.mask in stage.masks, f"its mask {stage.mask} is none of {stage.masks}")
    before = stage.mask
    for mask in (*stage.masks, before):
        stage.set_mask(mask)
        require(stage.mask == mask, f"the mask is not {mask}")
    require_raises(BadValue, "an unknown mask", lambda: stage.set_mask("no such mask"))
    require(stage.mask == before, "a refused mask changed the one in use")


def check_sample(stage: Stage) -> None:
    """It moves the sample in and out."""
    for is_in in (True, False, True, False):
        stage.set_sample_in(is_in)
        require(stage.is_sample_in is is_in, f"the sample is not {'in' if is_in else 'out'}")
    for move in (stage.set_sample_in, stage.note_sample):
        require_raises(BadValue, "the switch 'out'", move, "out")
    require(not stage.is_sample_in, "a refused switch moved the sample")


class StageContract:
    @pytest.mark.parametrize("check", [check_masks, check_sample])
    def test_stage_keeps_the_contract(self, stage: Stage, check: Callable[[Stage], None]) -> None:
        check(stage)

    def test_closes_and_refuses_further_calls(self, stage: Stage) -> None:
        stage.close()
        stage.close()
        commands = {"set_mask": ("square",), "set_sample_in": (True,), "properties": ()}
        require_all_raise(WrongState, calls(stage, ("masks", "mask", "is_sample_in"), commands))

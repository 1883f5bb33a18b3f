"""What every stage must do."""

from __future__ import annotations

from collections.abc import Callable

from drivers.contract.device import Calls, check_properties, require, require_all_raise, require_raises
from drivers.errors import BadValue, WrongState
from drivers.stage import Stage


def check_masks(stage: Stage) -> None:
    """Every mask that it names can be put in, and no other."""
    check_properties(stage)
    require(stage.mask in stage.masks, f"the mask that is in, {stage.mask}, is none of its own")
    before = stage.mask
    for mask in (*stage.masks, before):
        stage.set_mask(mask)
        require(stage.mask == mask, f"the mask {mask} is not in")
    require_raises(BadValue, "an unknown mask", lambda: stage.set_mask("no such mask"))
    require(stage.mask == before, "a refused mask did not leave the one before")


def check_sample(stage: Stage) -> None:
    """The sample goes in and out."""
    for sample_in in (True, False, True, False):
        stage.set_sample_in(sample_in)
        require(stage.is_sample_in is sample_in, f"the sample is not {'in' if sample_in else 'out'}")


def check_closes_for_good(stage: Stage) -> None:
    """It closes twice, and answers nothing afterwards but that it is closed."""
    stage.close()
    stage.close()
    require_all_raise(WrongState, calls_of(stage))


def calls_of(stage: Stage) -> Calls:
    """Every question and command there is."""
    return {
        "masks": lambda: stage.masks,
        "mask": lambda: stage.mask,
        "set_mask": lambda: stage.set_mask("square"),
        "is_sample_in": lambda: stage.is_sample_in,
        "set_sample_in": lambda: stage.set_sample_in(True),
        "properties": stage.properties,
    }


STAGE_CHECKS: tuple[Callable[[Stage], None], ...] = (check_masks, check_sample)

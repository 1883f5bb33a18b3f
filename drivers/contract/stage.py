"""Contract of all stages."""

from collections.abc import Callable

from drivers.contract.device import Calls, calls, check_properties, require, require_all_raise, require_raises
from drivers.errors import BadValue, WrongState
from drivers.stage import Stage


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
    for sample_in in (True, False, True, False):
        stage.set_sample_in(sample_in)
        require(stage.is_sample_in is sample_in, f"the sample is not {'in' if sample_in else 'out'}")


def check_closes(stage: Stage) -> None:
    """It closes, and twice; every later call raises."""
    stage.close()
    stage.close()
    require_all_raise(WrongState, calls_of(stage))


def calls_of(stage: Stage) -> Calls:
    """Every query and command."""
    commands = {"set_mask": ("square",), "set_sample_in": (True,), "properties": ()}
    return calls(stage, ("masks", "mask", "is_sample_in"), commands)


STAGE_CHECKS: tuple[Callable[[Stage], None], ...] = (check_masks, check_sample)

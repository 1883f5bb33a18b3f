"""Bench files of earlier versions, read as what they meant.

Version 0.1 had no setting for rotation, the response or the choice of the warp. Versions 0.1 and 0.2 neglected what
light does between sample and lenslets, and did not search for layers. All offered non-rigid registrations.
"""

import tomllib
from typing import Any

from app.bench.bench_files import BenchError, line_of_setting

_FLUX = "conserve_flux"  # of [registration], until version 0.2
# Every version after 0.1 writes `registration.rotation`, every version after 0.2 `field.neglect_propagation`.
_OF_VERSION_0_1 = {
    ("registration", "rotation"): True,
    ("registration", "warp"): "quadratic",
    ("reconstruction", "response"): False,
}
_UNTIL_VERSION_0_2 = {("field", "neglect_propagation"): True, ("reconstruction", "sample"): "free"}
_NON_RIGID = ("block_flow", "demons", "ffd")  # of `registration.method`
_FLOW = ("views", "warp")  # of `registration.flow`, which only these read


def set_recorded_defaults(tree: dict[str, Any]) -> None:
    """Set what the version of a recorded bench did before there were settings for it."""
    for (section, key), defaults in (
        (("registration", "rotation"), _OF_VERSION_0_1),
        (("field", "neglect_propagation"), _UNTIL_VERSION_0_2),
    ):
        if isinstance(tree.get(section, {}), dict) and key not in tree.get(section, {}):
            for (place, name), value in defaults.items():
                if isinstance(tree.setdefault(place, {}), dict):
                    tree[place].setdefault(name, value)


def replace_conserve_flux(tree: dict[str, Any], text: str, name: str, *, is_recorded: bool) -> None:
    """Replace `registration.conserve_flux` by `field.neglect_propagation`.

    Raises `BenchError` if it is false in a bench that is not recorded.
    """
    registration, field = (tree.get(section) for section in ("registration", "field"))
    if not isinstance(registration, dict) or not isinstance(registration.get(_FLUX), bool):
        return
    if registration.pop(_FLUX):
        if isinstance(field, dict):
            field.setdefault("neglect_propagation", True)
    elif not is_recorded:
        raise BenchError(
            f"{name}: registration.{_FLUX} = false is no longer offered: leave it out for real light, whose brightness"
            " is conserved, or set field.neglect_propagation = true for the paper's simulation",
            line_of_setting(text, f"registration.{_FLUX}"),
        )


def take_non_rigid(tree: dict[str, Any], text: str, name: str, *, is_recorded: bool) -> str:
    """Take a non-rigid method and its setting out of `[registration]`; return the method or "".

    Raises `BenchError` for such a method in a bench that is not recorded: recordings open, but cannot be reconstructed
    with it.
    """
    registration = tree.get("registration")
    if not isinstance(registration, dict):
        return ""
    if registration.get("flow") in _FLOW:
        del registration["flow"]
    method = registration.get("method")
    if method not in _NON_RIGID:
        return ""
    if not is_recorded:
        raise BenchError(
            f'{name}: registration.method = "{method}" is no longer offered: leave it out, or choose itk_affine or'
            " correlation; `svwfs paper table1 --peers` still compares it",
            line_of_setting(text, "registration.method"),
        )
    del registration["method"]
    return str(method)


def neglected_propagation(text: str) -> str:
    """Say that the version of a recorded bench neglected the propagation of light; else empty."""
    try:
        tree = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError):
        return ""
    field, registration = (tree.get(section, {}) for section in ("field", "registration"))
    if not isinstance(field, dict) or not isinstance(registration, dict) or "neglect_propagation" in field:
        return ""
    sentence = "recorded by version 0.1 or 0.2 with neglected propagation of light, and reconstructed so again"
    if registration.get(_FLUX, True):
        return sentence
    return f"{sentence}, but conserving flux: registration.{_FLUX} = false is no longer offered"

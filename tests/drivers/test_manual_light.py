"""Manual light: nothing is sent, and only a person's word counts."""

from __future__ import annotations

import pytest

from drivers.interface import BadValue, Range, WrongState
from drivers.light_source import ManualLight


def test_light_counts_as_on_until_a_person_says_otherwise() -> None:
    light = ManualLight()
    assert light.is_on
    light.set_on(True)
    with pytest.raises(WrongState, match=r"switch it off by hand, then confirm \(L\)"):
        light.set_on(False)
    assert light.is_on
    light.note_light(False)
    assert not light.is_on
    light.set_on(False)
    with pytest.raises(WrongState, match="switch it on by hand"):
        light.set_on(True)
    light.note_light(True)
    assert light.is_on


def test_word_is_no_switch() -> None:
    light = ManualLight()
    light.note_light(False)
    for switch in (light.note_light, light.set_on):
        with pytest.raises(BadValue, match="a switch takes True or False, not 'off'"):
            switch("off")  # type: ignore[arg-type] # refused
    assert not light.is_on


def test_light_has_no_current() -> None:
    light = ManualLight()
    assert light.current_range_a == Range(0, 0)
    assert light.set_current(0) == light.current_a == 0
    with pytest.raises(BadValue):
        light.set_current(0.1)


def test_closed_light_is_not_said_to_be_off() -> None:
    light = ManualLight()
    light.close()
    light.close()
    assert light._is_noted_on
    with pytest.raises(WrongState, match="closed"):
        light.note_light(False)

"""Data between processes: what arrives equals what was sent, and nothing but plain data of this program can arrive."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from hypothesis.extra import numpy as some_numpy

from app.acquisition.remote.messages import Command, portable_error
from app.acquisition.serialization import encoded, unpacked
from app.errors import InputError, RunError
from drivers.interface import Disconnected
from reconstruction.quality.verdict import Fault, Quality

SCALARS = (
    some.none() | some.booleans() | some.integers() | some.floats() | some.text() | some.builds(Path, some.just("a/b"))
)
ARRAYS = some_numpy.arrays(
    some.sampled_from(["u1", "u2", "f4", "f8", "?", "i8"]), some_numpy.array_shapes(min_dims=0, min_side=0)
)
VALUES = some.recursive(
    SCALARS | ARRAYS,
    lambda inner: (
        some.lists(inner)
        | some.lists(inner).map(tuple)
        | some.dictionaries(some.text() | some.integers(), inner)
        | some.builds(Command, some.integers(), some.text(), some.lists(inner).map(tuple))
    ),
    max_leaves=12,
)


def there_and_back(value: object) -> Any:
    return unpacked(encoded(value))


def assert_same(found: Any, sent: Any) -> None:
    assert type(found) is type(sent)
    if isinstance(sent, np.ndarray):
        assert found.dtype == sent.dtype
        np.testing.assert_array_equal(found, sent)
        assert not found.flags.writeable
    elif isinstance(sent, float) and math.isnan(sent):
        assert math.isnan(found)
    elif isinstance(sent, list | tuple):
        assert len(found) == len(sent)
        for one, other in zip(found, sent, strict=True):
            assert_same(one, other)
    elif isinstance(sent, Mapping):
        assert list(found) == list(sent)
        for key, value in sent.items():
            assert_same(found[key], value)
    elif isinstance(sent, Command):
        assert_same(found.arguments, sent.arguments)
    else:
        assert found == sent


@given(VALUES)
def test_values_arrive_as_they_were_sent(value: object) -> None:
    assert_same(there_and_back(value), value)


def test_slices_and_turned_arrays_arrive() -> None:
    array = np.arange(24).reshape(4, 6)
    for part in (array[::2, 1:5], array.T, np.broadcast_to(np.float32(3), (2, 3))):
        np.testing.assert_array_equal(there_and_back(part), part)


def test_enums_and_mappings_arrive() -> None:
    quality = Quality({Fault.SCALE: "the scale", Fault.CLIPPED | Fault.SCALE: "both"})
    assert there_and_back(quality).reasons == quality.reasons


@pytest.mark.parametrize("value", [{1, 2}, print, b"bytes", os.stat_result(range(10)), object()])
def test_other_things_cannot_be_sent(value: object) -> None:
    with pytest.raises(RunError, match="cannot be sent"):
        there_and_back(value)


@pytest.mark.parametrize(
    "plain",
    [
        {"os:system": ["true"]},
        {"subprocess:Popen": {"args": ["true"]}},
        {"http:HTTPStatus": 200},
        {"urllib.parse:DefragResult": ["a", "b"]},
        {"app.acquisition.worker:Acquisition": {"bench": None}},
        {"app.files:Path": ["x"]},
        {"app.acquisition.remote.messages:Notice": {"ring": "x"}},
        {"app.nothing:Notice": {}},
        {"code": "1"},
        {"array": 0},
        {"a": 1, "b": 2},
    ],
)
def test_nothing_but_plain_data_of_this_program_arrives(plain: object) -> None:
    refuse((plain, []))


@pytest.mark.parametrize("layout", [("f8", [1000]), ("O", [1]), ()])
def test_arrays_that_are_not_there_are_refused(layout: object) -> None:
    refuse(({"array": 0}, [layout]))


def refuse(header: object) -> None:
    text = json.dumps(header).encode()
    with pytest.raises(RunError, match="cannot be read"):
        unpacked(len(text).to_bytes(8, "little") + bytes(56) + text + bytes(128))


@pytest.mark.parametrize("kept", [0, 7, 8, 64, 80, -60])
def test_a_message_that_is_cut_short_is_refused(kept: int) -> None:
    message = bytes(encoded(Command(1, "take_dark", (np.arange(50),))))
    with pytest.raises(RunError, match="cannot be read"):
        unpacked(message[:kept])


@pytest.mark.parametrize("error", [InputError("no file"), Disconnected("unplugged"), RunError("x")])
def test_errors_keep_kind_and_sentence(error: Exception) -> None:
    made = there_and_back(portable_error(error))
    assert type(made) is type(error)
    assert str(made) == str(error)

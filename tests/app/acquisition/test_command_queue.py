"""Command queue: every future resolves once, after the command's consequences."""

from __future__ import annotations

from concurrent.futures import Future
from typing import NoReturn, cast

import pytest

from app.acquisition.command_queue import CommandQueue
from app.acquisition.instrument import Instrument
from drivers.interface import BadValue, Disconnected, OffCount

INSTRUMENT = cast("Instrument", object())  # only passed on by the queue


def _fail_with(error: Exception) -> NoReturn:
    raise error


@pytest.mark.parametrize("error", [None, BadValue("no such exposure"), ValueError("fault"), MemoryError()])
def test_afterwards_runs_before_future_resolves(error: Exception | None) -> None:
    was_told: list[bool] = []
    commands = CommandQueue(OffCount(), lambda _: was_told.append(future.done()))
    future: Future[int] = commands.submit(lambda _: 7 if error is None else _fail_with(error))
    execute = commands.next()
    assert execute is not None
    execute(INSTRUMENT)
    assert was_told == [False]
    assert future.done()
    assert future.exception() is error
    assert error is not None or future.result() == 7
    assert commands.next() is None


@pytest.mark.parametrize("fails", ["command", "afterwards"])
def test_fatal_error_reaches_waiting_future(fails: str) -> None:
    gone = Disconnected("the camera was unplugged")
    commands = CommandQueue(OffCount(), lambda _: _fail_with(gone))
    future = commands.submit(lambda _: _fail_with(gone) if fails == "command" else 7)
    execute = commands.next()
    assert execute is not None
    with pytest.raises(Disconnected):
        execute(INSTRUMENT)
    assert future.exception(0) is gone

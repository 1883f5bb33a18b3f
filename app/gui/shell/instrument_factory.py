"""The instrument or the recording that a window opens; a command chooses it before Qt is loaded."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from app.acquisition.remote.connection import RunningInstrument
from app.acquisition.start_up import start_up

if TYPE_CHECKING:
    from app.results.player import Player


@dataclass(frozen=True, slots=True)
class InstrumentFactory:
    """Makes and begins an acquisition, and another one after each reconnection."""

    make: Callable[[], RunningInstrument]
    begin: Callable[[RunningInstrument], tuple[Future[Any], ...]] = start_up  # sends the first commands
    player: Player | None = None  # of a recording

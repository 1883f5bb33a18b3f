"""All devices of a bench together."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Self

from drivers.camera import Camera
from drivers.light_source import LightSource
from drivers.stage import Stage


@dataclass(frozen=True, slots=True, eq=False)
class Devices:
    """The devices of one bench, open; closing turns the light off first."""

    camera: Camera
    light: LightSource
    stage: Stage
    _closing: ExitStack = field(default_factory=ExitStack)

    def close(self) -> None:
        """Close all of them, each even if another fails."""
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

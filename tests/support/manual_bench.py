"""A bench without motors, and a person who operates it."""

from __future__ import annotations

from dataclasses import replace

from drivers.genicam import GenicamSettings
from drivers.serial_lights import DC4100Settings
from support.gui_bench import BENCH, FakeCamera

MANUAL = replace(BENCH, camera=GenicamSettings(), light=DC4100Settings(port="COM1"))


class Person:
    """Standard input of a person who presses Enter; records the state of the bench each time."""

    def __init__(self, camera: FakeCamera, presses: int) -> None:
        self._camera, self._presses = camera, presses
        self.saw: list[tuple[bool, bool]] = []  # whether the light was on, and the sample noted as in

    def isatty(self) -> bool:
        return True

    def readline(self) -> str:
        self.saw.append((self._camera.light.is_on, self._camera.stage.is_sample_in))
        self._presses -= 1
        return "\n" if self._presses >= 0 else ""

"""What the user wants, passed on to the acquisition of the moment; there may be none, or another one later."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from typing import Any

from app.acquisition.instrument import Instrument
from app.acquisition.worker import Acquisition
from app.gui import commands
from app.gui.answers import Answers
from app.gui.controls_panel import ControlsPanel


class Orders:
    """Gives orders to an acquisition, and has their answers waited for."""

    def __init__(self, answers: Answers) -> None:
        self._answers = answers
        self.acquisition: Acquisition | None = None

    def command(self, command: Callable[[Instrument, Any], object]) -> Callable[[Any], None]:
        """Return what has the worker execute a command with the value that is asked for."""

        def call(value: object) -> None:
            if self.acquisition is not None:
                self._answers.expect(self.acquisition.submit(lambda instrument: command(instrument, value)))

        return call

    def routine(self, routine: Callable[[Acquisition, int], Future[None]]) -> Callable[[int], None]:
        """Return what has a routine executed with so many frames."""

        def call(frames: int) -> None:
            if self.acquisition is not None:
                self._answers.expect(routine(self.acquisition, frames))

        return call

    def to(self, act: Callable[..., object], **how: object) -> Callable[[], None]:
        """Return what has `act` called with the acquisition of then, if there is one."""

        def call() -> None:
            if self.acquisition is not None:
                partial(act, **how)(self.acquisition)

        return call


def connect_controls(controls: ControlsPanel, orders: Orders) -> None:
    """Have every control that sets something order it."""
    for intent, command in (
        (controls.running_requested, commands.set_running),
        (controls.exposure_requested, commands.set_exposure),
        (controls.amplifier_requested, commands.set_amplifier),
        (controls.readout_speed_requested, commands.set_readout_speed),
        (controls.em_gain_requested, commands.set_em_gain),
        (controls.light_requested, commands.set_light),
        (controls.current_requested, commands.set_current),
        (controls.sample_requested, commands.set_sample),
        (controls.mask_requested, commands.set_mask),
    ):
        intent.connect(orders.command(command))
    controls.dark_requested.connect(orders.routine(Acquisition.take_dark))
    controls.reference_requested.connect(orders.routine(Acquisition.take_reference))
    controls.setting_requested.connect(
        lambda section, key, value: orders.command(partial(commands.change_setting, section, key))(value)
    )

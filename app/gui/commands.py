"""What the window has the acquisition's worker do between two frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from app.acquisition.instrument import Instrument
from app.bench.config import Bench
from reconstruction.geometry import Lattice


def set_running(instrument: Instrument, running: bool) -> None:
    """Start or stop the camera."""
    camera = instrument.devices.camera
    if running and not camera.is_running:
        camera.start()
    elif not running:
        camera.stop()


def set_exposure(instrument: Instrument, exposure_s: float) -> None:
    """Set the camera's exposure time."""
    instrument.devices.camera.set_exposure(exposure_s)


def set_amplifier(instrument: Instrument, amplifier: str) -> None:
    """Choose the camera's amplifier, stopping it for the change."""
    with instrument.devices.camera.paused() as camera:
        camera.set_amplifier(amplifier)


def set_readout_speed(instrument: Instrument, readout_speed: int) -> None:
    """Choose the camera's readout speed, stopping it for the change."""
    with instrument.devices.camera.paused() as camera:
        camera.set_readout_speed(readout_speed)


def set_em_gain(instrument: Instrument, em_gain: float) -> None:
    """Set the camera's electron multiplication."""
    instrument.devices.camera.set_em_gain(em_gain)


def set_light(instrument: Instrument, on: bool) -> None:
    """Switch the light."""
    instrument.devices.light.set_on(on)


def set_current(instrument: Instrument, current_a: float) -> None:
    """Set the light's current."""
    instrument.devices.light.set_current(current_a)


def set_sample(instrument: Instrument, sample_in: bool) -> None:
    """Move the sample into or out of the beam, or take note that a person has."""
    instrument.devices.stage.note_sample(sample_in)


def set_mask(instrument: Instrument, mask: str) -> None:
    """Put a mask in front of the light."""
    instrument.devices.stage.set_mask(mask)


def use_lattice(instrument: Instrument, lattice: Lattice) -> None:
    """Have the lenslets where they were found."""
    instrument.change_settings(lambda bench: replace(bench, lattice=lattice))


def change_setting(section: str, key: str, instrument: Instrument, value: Any) -> None:
    """Change one setting of the bench."""

    def change(bench: Bench) -> Bench:
        changed: dict[str, Any] = {section: replace(getattr(bench, section), **{key: value})}
        return replace(bench, **changed)

    instrument.change_settings(change)

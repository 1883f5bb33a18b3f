"""Menus of the main window: every command with its key."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from app.gui.file_dialogs import choose_recordings_folder, save_bench
from app.gui.menu import Entries
from app.results.view_analysis import Quantity

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow


def window_menus(window: MainWindow) -> Mapping[str, Entries]:
    """Return the entries of all menus but the help."""
    controls, camera, wavefront, messages = (
        window.controls,
        window.camera_panel,
        window.wavefront_panel,
        window.messages,
    )
    return {
        "&File": (
            ("Start or stop recording", "W", window.recording_panel.record.click),
            ("Save the last seconds", "K", window.recording_panel.keep.click),
            ("Choose the recordings folder", "Ctrl+O", partial(choose_recordings_folder, window)),
            ("Save the bench", "Ctrl+S", partial(save_bench, window)),
            ("Save a screenshot", "Ctrl+P", window.save_screenshot),
            ("Quit", "Ctrl+Q", window.quit),
        ),
        "&Bench": (
            ("Start or stop the camera", "Space", controls.start.click),
            ("Switch the light", "L", controls.light.click),
            ("Move the sample in or out", "S", controls.sample.click),
            ("Take a dark", "D", controls.dark.click),
            ("Take a reference", "R", controls.reference.click),
            ("Find the lattice", "N", controls.lattice.click),
            ("Find the exposure", "X", controls.auto_exposure.click),
            ("Check the background", "B", window.controller.check_background),
            ("Accept the proposal", "Return", messages.enter),
            ("Cancel, discard or dismiss", "Esc", messages.escape),
            ("Toggle refinement", "F", controls.refine.click),
            ("Edit the exposure", "E", controls.exposure.edit),
            ("Edit the current", "C", controls.current.edit),
            ("Choose the sensor region", "P", controls.sensor_region.click),
            ("Reconnect after a failure", "Ctrl+R", messages.reconnect.click),
        ),
        "&View": (
            ("Lattice", "G", camera.lattice_toggle.toggle),
            ("Arrows", "A", camera.arrows_toggle.toggle),
            ("Freeze the colour scale", "H", wavefront.freeze_scale.toggle),
            ("Enlarge the selected view", "V", wavefront.enlarge),
            ("Plots below the camera image", "I", window.toggle_analysis),
            ("Whole camera image", "0", camera.reset_zoom),
            ("Previous frame of a replay", ",", window.replay.back.click),
            ("Next frame of a replay", ".", window.replay.forth.click),
            ("Full screen", "F11", window.toggle_full_screen),
            ("Processing times", "T", window.status_line.timing_row.toggle),
            *(
                (f"{quantity} over the field", str(index + 1), partial(wavefront.choose, quantity))
                for index, quantity in enumerate(Quantity)
            ),
        ),
    }

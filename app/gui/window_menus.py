"""Menus of the main window: every command with its key."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from PyQt6.QtCore import Qt

from app.gui.device_presets import DevicePresets
from app.gui.file_dialogs import choose_recording, choose_recordings_folder, export_history, export_view
from app.gui.menu import Entries
from app.gui.preferences import PreferencesDialog
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
    full, settings = Qt.WindowState.WindowFullScreen, window.benches.remembered
    presets = preferences = None  # of a window that remembers nothing
    if settings is not None:
        presets = DevicePresets(lambda: window.controller.status, controls, settings, window)
        preferences = PreferencesDialog(settings, window)
    return {
        "&File": (
            ("Start or stop recording", "W", window.recording_panel.record),
            ("Name, note and end of the recording", "Shift+W", window.recording_bar.prepare),
            ("Save the last seconds", "K", window.recording_panel.keep),
            ("Replay a recording", "Ctrl+Shift+O", partial(choose_recording, window)),
            ("Replay a recent recording", "", window.recording_bar.recent_menu()),
            ("Choose the recordings folder", "", partial(choose_recordings_folder, window)),
            None,
            ("Export the shown wavefronts", "Ctrl+E", partial(export_view, window)),
            ("Export the history", "", partial(export_history, window)),
            ("Save a screenshot", "Ctrl+P", window.save_screenshot),
            None,
            ("Quit", "Ctrl+Q", window.quit),
        ),
        "&Bench": (
            ("Open a bench", "Ctrl+O", window.benches.ask),
            ("Open a recent bench", "", window.benches.recent_menu()),
            ("Open a preset", "", window.benches.presets_menu()),
            ("New bench from my camera", "Ctrl+N", window.benches.make),
            ("Settings of the bench", "Ctrl+,", window.benches.edit),
            ("Save the bench", "Ctrl+S", window.benches.save),
            None,
            ("Start or stop the camera", "Space", controls.start),
            ("Light on", "L", controls.light),
            ("Sample in", "S", controls.sample),
            *(() if presets is None else (("Presets of exposure and mask", "", presets.show),)),
            ("Edit the exposure", "E", controls.exposure.edit),
            ("Edit the current", "C", controls.current.edit),
            ("Choose the sensor region", "P", controls.sensor_region),
            None,
            ("Calibrate step by step", "Ctrl+K", controls.calibrate),
            ("Find the exposure", "X", controls.auto_exposure),
            ("Take a dark", "D", controls.dark),
            ("Take a reference", "R", controls.reference),
            ("Find the lattice", "N", controls.lattice),
            ("Check the background", "B", window.controller.check_background),
            None,
            ("Refinement", "F", controls.refine),
            None,
            ("Accept the proposal", "Return", messages.enter),
            ("Cancel, discard or dismiss", "Esc", messages.escape),
            ("Reconnect after a failure", "Ctrl+R", messages.reconnect),
        ),
        "&View": (
            *(
                (f"{quantity} over the field", str(index + 1), partial(wavefront.choose, quantity))
                for index, quantity in enumerate(Quantity)
            ),
            None,
            ("Lattice", "G", camera.lattice_toggle),
            ("Arrows", "A", camera.arrows_toggle),
            ("Whole camera image", "0", camera.reset_zoom),
            ("Freeze the colour scale", "H", wavefront.freeze_scale),
            ("Enlarge the selected view", "V", wavefront.enlarge),
            ("Previous frame of a replay", ",", window.replay.back),
            ("Next frame of a replay", ".", window.replay.forth),
            ("Processing times", "T", window.status_line.timing_row.toggle),
            None,
            ("Panels", "", window.docks.menu()),
            ("Plots", "I", window.docks.toggle_analysis),
            ("Restore default layout", "", window.docks.restore_default),
            *(() if preferences is None else (("Preferences", "", preferences.show),)),
            ("Full screen", "F11", lambda: window.setWindowState(window.windowState() ^ full)),
        ),
    }

"""What can be set: camera, light and stage, dark and reference, registration and reconstruction.

The panel shows the instrument's status and emits what its user wants, as plain values in SI units.
"""

from __future__ import annotations

from typing import get_args

from PyQt6.QtCore import pyqtSignal
from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QComboBox, QFrame, QGridLayout, QHBoxLayout, QSizePolicy, QWidget

from app.acquisition.instrument import Standing, Status
from app.bench.config import AUTOMATIC
from app.gui import theme
from app.gui.number_field import NumberField
from app.gui.widgets import button, label, toggle
from drivers.interface import Range
from reconstruction.settings import FIELD_MODES, Method, PupilBasis, RegistrationSettings

_MOST_FRAMES = 1000
_FEWEST_PUPIL_MODES, _MOST_PUPIL_MODES = 3, 400
_PUPIL_MODES_RANGE = Range(_FEWEST_PUPIL_MODES - 1, _MOST_PUPIL_MODES)  # its lowest is shown as the word above

_LAMPS: dict[Standing, QColor] = {"missing": theme.LINE, "doubtful": theme.AMBER, "good": theme.GREEN}


class ControlsPanel(QFrame):
    """Emits intents; it changes what it shows only when the instrument's status has changed."""

    running_requested = pyqtSignal(bool)
    exposure_requested = pyqtSignal(float)  # s
    read_out_requested = pyqtSignal()
    amplifier_requested = pyqtSignal(str)
    readout_speed_requested = pyqtSignal(int)
    em_gain_requested = pyqtSignal(float)
    light_requested = pyqtSignal(bool)
    current_requested = pyqtSignal(float)  # A
    sample_requested = pyqtSignal(bool)
    mask_requested = pyqtSignal(str)
    dark_requested = pyqtSignal(int)  # frames
    reference_requested = pyqtSignal(int)  # frames
    lattice_requested = pyqtSignal()
    auto_exposure_requested = pyqtSignal()
    setting_requested = pyqtSignal(str, str, object)  # section and key of the bench, and the value

    def __init__(self, frames: int, parent: QWidget | None = None) -> None:
        """Offer averages over `frames` frames to begin with."""
        super().__init__(parent)
        self.setProperty("role", "strip")
        self._layout = QHBoxLayout(self)
        self._layout.setContentsMargins(10, 6, 10, 8)
        self._layout.setSpacing(8)
        self._make_camera()
        self._make_bench()
        self._make_calibration(frames)
        self._make_reconstruction()
        self.setEnabled(False)

    def _make_camera(self) -> None:
        self._is_running = False
        self.start = button("Start", "Start or stop taking frames (Space)")
        self.start.clicked.connect(lambda: self.running_requested.emit(not self._is_running))
        self.read_out = button("Region\N{HORIZONTAL ELLIPSIS}", "Read out another part of the sensor, or bin it (P)")
        self.read_out.clicked.connect(self.read_out_requested)
        self.exposure = NumberField(
            unit=1e-3, suffix=" ms", decimals=3, tool_tip="Exposure time; shown is what the camera took"
        )
        self.exposure.entered.connect(self.exposure_requested)
        self.amplifier = _choice("The camera's output amplifier; it is stopped and started again for the change")
        self.amplifier.textActivated.connect(self.amplifier_requested)
        self.readout_speed = _choice("Read-out speed: the faster, the noisier; the camera is stopped for the change")
        self.readout_speed.setMinimumWidth(40)
        self.readout_speed.textActivated.connect(lambda speed: self.readout_speed_requested.emit(int(speed)))
        self.em_gain = NumberField(decimals=1, tool_tip="Electron multiplication: more signal over the read noise")
        self.em_gain.setPrefix("\N{MULTIPLICATION SIGN} ")
        self.em_gain.entered.connect(self.em_gain_requested)
        grid = self._section("Camera")
        grid.addLayout(_side_by_side(self.start, self.read_out), 1, 0, 1, 2)
        grid.addWidget(label("Exposure", "dim"), 2, 0)
        grid.addWidget(self.exposure, 2, 1)
        mode = _side_by_side(label("Gain", "dim"), self.em_gain, self.amplifier, self.readout_speed)
        for narrow in (0, 3):
            mode.setStretch(narrow, 0)
        grid.addLayout(mode, 3, 0, 1, 2)

    def _make_bench(self) -> None:
        self.light = toggle("Light off", "Switch the light (L)")
        self.light.clicked.connect(self.light_requested)
        self.sample = toggle("Sample out", "Move the sample into or out of the beam (S)")
        self.sample.clicked.connect(self.sample_requested)
        self.current = NumberField(unit=1e-3, suffix=" mA", decimals=1, tool_tip="The light's current, when it is on")
        self.current.entered.connect(self.current_requested)
        self.mask_choice = _choice("The mask in front of the light; another mask needs another reference")
        self.mask_choice.textActivated.connect(self.mask_requested)
        grid = self._section("Light and stage")
        grid.addLayout(_side_by_side(self.light, self.sample), 1, 0, 1, 2)
        grid.addWidget(label("Current", "dim"), 2, 0)
        grid.addWidget(self.current, 2, 1)
        grid.addWidget(label("Mask", "dim"), 3, 0)
        grid.addWidget(self.mask_choice, 3, 1)

    def _make_calibration(self, frames: int) -> None:
        self.frames = NumberField(tool_tip="How many frames are averaged into a dark or a reference")
        self.frames.show_value(frames, Range(1, _MOST_FRAMES))
        self.dark = button("Dark", "Average frames with the light off, to be subtracted from all others (D)")
        self.dark.clicked.connect(lambda: self.dark_requested.emit(round(self.frames.value())))
        self.reference = button("Reference", "Average frames without the sample: displacements count from here (R)")
        self.reference.clicked.connect(lambda: self.reference_requested.emit(round(self.frames.value())))
        self.lattice = button("Lattice", "Find the lenslets in the reference; nothing changes until you agree (N)")
        self.lattice.clicked.connect(self.lattice_requested)
        self.auto_exposure = button(
            "Expose", "Find the exposure, and if need be the current, that fills 70 % of the camera's range (X)"
        )
        self.auto_exposure.clicked.connect(self.auto_exposure_requested)
        grid = self._section("Calibration")
        grid.addLayout(_side_by_side(self.dark, self.reference), 1, 0, 1, 2)
        grid.addWidget(label("Frames", "dim"), 2, 0)
        grid.addWidget(self.frames, 2, 1)
        grid.addLayout(_side_by_side(self.lattice, self.auto_exposure), 3, 0, 1, 2)

    def _make_reconstruction(self) -> None:
        self.registration = self._setting(
            "registration",
            "method",
            "How subimages are compared with the reference: gauss_newton is this instrument's own; the others are the "
            "paper's and its peers', some of them far too slow to watch",
        )
        self.warp = self._setting(
            "registration",
            "warp",
            "How a subimage may differ from its reference: moved (translation), also stretched and turned (affine), "
            "or bent (quadratic, cubic). The more, the finer the wavefront's change over the field. "
            "Most other methods do without",
        )
        self.method = self._setting(
            "reconstruction",
            "method",
            "From slopes to wavefronts: lenslet by lenslet (zonal), or by polynomials (modal)",
        )
        self.basis = self._setting(
            "reconstruction", "basis", "Polynomials of the modal method: for a square pupil, or for a circular one"
        )
        self.pupil_modes = NumberField(
            tool_tip="How many polynomials over the pupil the modal method fits; automatic: as many as the lattice"
            " carries, smoothed by as much as the noise demands",
            lowest=AUTOMATIC,
        )
        self.pupil_modes.entered.connect(
            lambda value: self.setting_requested.emit(
                "reconstruction", "pupil_modes", None if value < _FEWEST_PUPIL_MODES else round(value)
            )
        )
        self.refine = toggle(
            "Refine", "Correct every frame by the bias that a forward model finds beside the live view (F)"
        )
        self.refine.clicked.connect(lambda on: self.setting_requested.emit("reconstruction", "refine", on))
        grid = self._section("Reconstruction", is_last=True)
        grid.addWidget(label("Register", "dim"), 1, 0)
        grid.addLayout(_side_by_side(self.registration, self.warp), 1, 1)
        grid.addWidget(label("Integrate", "dim"), 2, 0)
        grid.addLayout(_side_by_side(self.method, self.basis), 2, 1)
        grid.addWidget(label("Modes", "dim"), 3, 0)
        grid.addLayout(_side_by_side(self.pupil_modes, self.refine), 3, 1)

    def _setting(self, section: str, key: str, tool_tip: str) -> QComboBox:
        """A choice of one of the bench's settings."""
        choice = _choice(tool_tip)
        choice.textActivated.connect(
            lambda value: self.setting_requested.emit(section, key, None if value == AUTOMATIC else value)
        )
        return choice

    def _section(self, title: str, *, is_last: bool = False) -> QGridLayout:
        """Begin another column of controls under a title, and rule it off from the next."""
        grid = QGridLayout()
        grid.setVerticalSpacing(5)
        grid.setHorizontalSpacing(8)
        grid.setColumnStretch(1, 1)
        grid.addWidget(label(title, "title"), 0, 0, 1, 2)
        for row in range(1, 4):
            grid.setRowMinimumHeight(row, self.start.sizeHint().height())  # so that all sections' rows are in line
        self._layout.addLayout(grid, 2 if is_last else 1)  # the last has the longest words
        if not is_last:
            rule = QFrame()
            rule.setFixedWidth(1)
            rule.setStyleSheet(f"background: {theme.LINE.name()};")
            self._layout.addWidget(rule)
        return grid

    def show_status(self, status: Status, *, is_settled: bool) -> None:
        """Show how the instrument stands; a field that is being edited is left alone until all `is_settled`."""
        allowed = status.capabilities
        self.start.setText("Stop" if status.is_running else "Start")
        self.start.setIcon(theme.start_or_stop(is_running=status.is_running))
        self._is_running = status.is_running
        for field, value, interval in (
            (self.exposure, status.exposure_s, allowed.exposure_range_s),
            (self.em_gain, status.em_gain, allowed.em_gain_range),
            (self.current, status.current_a, status.current_range_a),
            (self.pupil_modes, status.bench.reconstruction.pupil_modes or 0, _PUPIL_MODES_RANGE),
        ):
            if is_settled or not field.hasFocus():
                field.show_value(value, interval)
        self.em_gain.setEnabled(allowed.em_gain_range.maximum > allowed.em_gain_range.minimum)
        _show_choice(self.amplifier, allowed.amplifiers, status.amplifier)
        _show_choice(self.readout_speed, tuple(map(str, allowed.readout_speeds)), str(status.readout_speed))
        _show_choice(self.mask_choice, status.masks, status.mask)
        registration, reconstruction = status.bench.registration, status.bench.reconstruction
        _show_choice(self.registration, get_args(Method), registration.method)
        _show_choice(self.warp, (AUTOMATIC, *FIELD_MODES), registration.warp or AUTOMATIC)
        _show_choice(self.method, ("zonal", "modal"), reconstruction.method)
        _show_choice(self.basis, get_args(PupilBasis), reconstruction.basis)
        self.warp.setEnabled(_uses_warp(registration))
        self.refine.setChecked(reconstruction.refine)
        for choice in (self.basis, self.pupil_modes):
            choice.setEnabled(reconstruction.method == "modal")
        for shown, words, is_on, colour in (
            (self.light, ("Light off", "Light on"), status.is_light_on, theme.AMBER),
            (self.sample, ("Sample out", "Sample in"), status.is_sample_in, theme.ACCENT),
        ):
            shown.setText(words[is_on])
            shown.setChecked(is_on)
            shown.setIcon(theme.lamp(colour if is_on else theme.LINE))
        for taken, standing in ((self.dark, status.dark), (self.reference, status.reference)):
            taken.setIcon(theme.lamp(_LAMPS[standing]))


def _uses_warp(registration: RegistrationSettings) -> bool:
    if registration.method in {"block_flow", "demons", "ffd"}:
        return registration.flow == "warp"
    return registration.method == "gauss_newton"


def _side_by_side(*widgets: QWidget) -> QHBoxLayout:
    row = QHBoxLayout()
    row.setSpacing(6)
    for widget in widgets:
        row.addWidget(widget, 1)
    return row


def _choice(tool_tip: str) -> QComboBox:
    choice = QComboBox()
    choice.setToolTip(tool_tip)
    choice.setMinimumWidth(64)
    choice.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
    return choice


def _show_choice(choice: QComboBox, allowed: tuple[str, ...], chosen: str) -> None:
    if tuple(choice.itemText(index) for index in range(choice.count())) != allowed:
        choice.clear()
        choice.addItems(allowed)
        if (words := choice.view()) is not None:
            words.setMinimumWidth(words.sizeHintForColumn(0) + 8)  # whole words, however narrow the choice itself is
    choice.setCurrentText(chosen)  # no user's choice, so `textActivated` is silent
    choice.setEnabled(len(allowed) > 1)

"""The controls panel: the light; devices, calibration in its order, and reconstruction; all values are in SI units."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, get_args

from PyQt6.QtCore import QSize, pyqtBoundSignal, pyqtSignal
from PyQt6.QtWidgets import QAbstractButton, QAbstractSpinBox, QComboBox, QFrame, QHBoxLayout, QSizePolicy, QWidget

from app.acquisition.instrument import Status
from app.acquisition.kept_averages import Validity, taken_at
from app.acquisition.start_up import DARK, EXPOSURE, LATTICE, REFERENCE
from app.bench.config import AUTOMATIC, Bench
from app.gui import theme
from app.gui.automatic_tips import MODES_TIP, WARP_TIP
from app.gui.number_field import NumberField
from app.gui.presentation import percent
from app.gui.step_button import StepButton
from app.gui.widgets import Button, Choice, Item, Slot, button, column, label, mark_wanted, row, toggle
from app.measurement.averages import AVERAGED_FRAMES
from app.results.pictures import FrameStatistics
from drivers.interface import Range
from reconstruction.settings import FIELD_MODES, PUPIL_MODES, Method, PupilBasis

_FRAMES_RANGE = Range(AVERAGED_FRAMES.start, AVERAGED_FRAMES[-1])
_GAP, _GROUP_GAP = 4, 8  # px between controls, and between groups of them
_LIGHT_WIDTH, _LIGHT_LAMP = 96, 20  # px
_DARK_TIP = "Average frames with the light off: the background of all frames (D)"
_DIM = 0.3  # share of full scale below which noise matters
_REFERENCE_TIP = "Average frames without the sample: spot positions that count as zero (R)"


class ControlsPanel(QFrame):
    """Emits the user's intents and shows the status of the instrument."""

    running_requested = pyqtSignal(bool)
    exposure_requested = pyqtSignal(float)  # s
    sensor_region_requested = pyqtSignal()
    amplifier_requested = pyqtSignal(str)
    readout_speed_requested = pyqtSignal(int)
    em_gain_requested = pyqtSignal(float)
    light_requested = pyqtSignal(bool)
    current_requested = pyqtSignal(float)  # A
    sample_requested = pyqtSignal(bool)
    mask_requested = pyqtSignal(str)
    dark_requested = pyqtSignal(int)  # frames
    reference_requested = pyqtSignal(int)  # frames
    calibration_requested = pyqtSignal(int)  # frames
    lattice_requested = pyqtSignal()
    auto_exposure_requested = pyqtSignal()
    setting_requested = pyqtSignal(str, str, object)  # section, key and value of the bench

    def __init__(self, frames: int, parent: QWidget | None = None) -> None:
        """Start with averages over `frames` frames."""
        super().__init__(parent)
        self.setProperty("role", "strip")
        self._make_camera()
        self._make_bench()
        self._make_calibration(frames)
        self._make_reconstruction()
        light = column((self.light, 1), self.current, spacing=5)
        rule = QFrame()
        rule.setFixedWidth(1)
        rule.setProperty("role", "rule")
        exposure = _named("Exposure", (self.exposure, 2))
        gain = _named("Gain", (self.em_gain, 1), (self.amplifier, 1))
        devices = (self.start, self.sensor_region, (exposure, 3), (gain, 4), (_named("Speed", self.readout_speed), 0))
        calibration: list[Item] = [self.lattice]
        for step in (self.auto_exposure, self.dark, self.reference):
            calibration += [label("\N{SINGLE RIGHT-POINTING ANGLE QUOTATION MARK}", "dim"), step]
        lines = (
            row(*devices, self.sample, (self.mask_choice, 2), spacing=_GROUP_GAP),
            row(*calibration, _named("Frames", self.frames), self.calibrate, spacing=_GROUP_GAP // 2),
            row(
                (_named("Matching", (self.registration, 3), (self.warp, 2)), 5),
                (_named("Wavefront", (self.method, 1), (self.basis, 1)), 4),
                (_named("Modes", (self.pupil_modes, 1)), 2),
                (self.refine, 1),
                spacing=_GROUP_GAP,
            ),
        )
        row(light, rule, (column(*lines, spacing=5), 1), spacing=_GROUP_GAP, parent=self).setContentsMargins(8, 6, 8, 6)
        self.setEnabled(False)

    def _make_camera(self) -> None:
        self._is_running = False
        self.start = button("Start", "Start or stop taking frames (Space)", self._toggle_running)
        self.start.setMinimumWidth(self.start.sizeHint().width() + self.start.iconSize().width() + _GAP)
        self.sensor_region = button(
            "Region\N{HORIZONTAL ELLIPSIS}",
            "Choose the sensor region and the binning (P)",
            self.sensor_region_requested,
        )
        self.exposure = NumberField(name="Exposure", unit="ms", decimals=3, tool_tip="Exposure time in force (E)")
        self.exposure.entered.connect(self.exposure_requested)
        self.em_gain = NumberField(
            name="Gain", decimals=1, tool_tip="Electron-multiplying gain: more signal above the read noise"
        )
        self.em_gain.entered.connect(self.em_gain_requested)
        self.amplifier = _choice("Output amplifier; a change restarts the camera", self.amplifier_requested)
        self.readout_speed = _choice(
            "Readout speed: faster is noisier; a change restarts the camera",
            lambda speed: self.readout_speed_requested.emit(int(speed)),
        )

    def _make_bench(self) -> None:
        self.light = toggle("Light off", "Switch the light (L)", self.light_requested, kind=_LightButton)
        self.light.setProperty("role", "light")
        self.light.setIconSize(QSize(_LIGHT_LAMP, _LIGHT_LAMP))
        self.light.setMinimumWidth(_LIGHT_WIDTH)
        self.light.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
        self.sample = toggle("Sample out", "Move the sample into or out of the beam (S)", self.sample_requested)
        self.current = NumberField(name="Current", unit="mA", decimals=1, tool_tip="Current of the light while on (C)")
        self.current.entered.connect(self.current_requested)
        self.mask_choice = _choice(
            "Mask in front of the light; a new mask needs a new reference (R)", self.mask_requested
        )

    def _make_calibration(self, frames: int) -> None:
        self.frames = NumberField(name="Frames", tool_tip="Number of frames averaged into a dark or a reference")
        self.frames.show_value(frames, _FRAMES_RANGE)
        self.lattice = StepButton(
            f"1 {LATTICE.title}",
            "Find the lenslets in the reference and propose a lattice (N)",
            self.lattice_requested,
            widest="",
        )
        self.auto_exposure = StepButton(
            f"2 {EXPOSURE.title}",
            "Find the exposure, and if needed the current, that fills 70 % of the camera's range (X)",
            self.auto_exposure_requested,
        )
        self.dark = StepButton(f"3 {DARK.title}", _DARK_TIP, lambda: self._request_average(self.dark_requested))
        self.reference = StepButton(
            f"4 {REFERENCE.title}", _REFERENCE_TIP, lambda: self._request_average(self.reference_requested)
        )
        self.calibrate = button(
            "Calibrate",
            "Find lattice and exposure, take dark and reference, with an explanation of each step (Ctrl+K)",
            lambda: self._request_average(self.calibration_requested),
        )

    def _make_reconstruction(self) -> None:
        self.registration = self._setting(
            "registration.method",
            "Matching of the subimages with the reference: Gauss-Newton is this instrument's own method;\n"
            "the others come from the paper and related software, and some are too slow for live use",
        )
        self.warp = self._setting("registration.warp", WARP_TIP)
        self.method = self._setting(
            "reconstruction.method", "Wavefront from the slopes: lenslet by lenslet (zonal) or as polynomials (modal)"
        )
        self.basis = self._setting(
            "reconstruction.basis",
            "Polynomials of the modal method: Legendre for a square pupil, Zernike for a circular one",
        )
        self.pupil_modes = NumberField(name="Modes", tool_tip=MODES_TIP, lowest=AUTOMATIC)
        self.pupil_modes.entered.connect(
            lambda value: self._request("reconstruction.pupil_modes", round(value) if value in PUPIL_MODES else None)
        )
        self.refine = toggle(
            "Refine",
            "Correct systematic errors by a simulation of your bench, updated about every second (F)",
            lambda on: self._request("reconstruction.refine", on),
        )

    def _setting(self, key: str, tool_tip: str) -> Choice:
        """Make a choice for a setting of the bench."""
        return _choice(tool_tip, lambda value: self._request(key, None if value == AUTOMATIC else value))

    def _request(self, key: str, value: object) -> None:
        self.setting_requested.emit(*key.split("."), value)

    def _request_average(self, request: pyqtBoundSignal) -> None:
        if self.frames.commit():  # the button does not take the focus from it
            request.emit(round(self.frames.value()))

    def _toggle_running(self) -> None:
        self.running_requested.emit(not self._is_running)

    def show_switching_off(self) -> None:
        """Show that the light is being switched off."""
        self.light.setText("Switching\noff \N{HORIZONTAL ELLIPSIS}")

    def enable_devices(self, *, is_enabled: bool) -> None:
        """Enable all, or only the reconstruction and the start button: a recording plays in place of the devices."""
        reconstruction = {self.registration, self.warp, self.method, self.basis, self.pupil_modes, self.refine}
        for control in self.findChildren((QAbstractButton, QAbstractSpinBox, QComboBox)):
            if control not in {*reconstruction, self.start}:
                control.setEnabled(is_enabled)

    def show_status(
        self, status: Status, *, is_settled: bool, wanted: Mapping[str, Any] = MappingProxyType({})
    ) -> None:
        """Show the status, and settings that are `wanted` (see `SettingsControl`) in place of those in force.

        A focused field changes only when all commands are finished (`is_settled`).
        """
        allowed = status.capabilities
        self.start.setText("Stop" if status.is_running else "Start")
        self.start.setIcon(theme.start_or_stop(is_running=status.is_running))
        self._is_running = status.is_running
        registration, reconstruction = status.bench.registration, status.bench.reconstruction
        for name, field, value, interval in (
            ("exposure", self.exposure, status.exposure_s, allowed.exposure_range_s),
            ("em_gain", self.em_gain, status.em_gain, allowed.em_gain_range),
            ("current", self.current, status.current_a, status.current_range_a),
            ("reconstruction.pupil_modes", self.pupil_modes, reconstruction.pupil_modes, _modes_range(status.bench)),
        ):
            mark_wanted(field, is_wanted=name in wanted)
            if is_settled or not field.hasFocus():
                field.show_value(wanted.get(name, value) or 0, interval)
        self.current.setEnabled(status.current_range_a.maximum > status.current_range_a.minimum)
        self.em_gain.setEnabled(allowed.em_gain_range.maximum > allowed.em_gain_range.minimum)
        speeds = tuple(map(str, allowed.readout_speeds))
        for name, choice, texts, chosen in (
            ("amplifier", self.amplifier, allowed.amplifiers, status.amplifier),
            ("readout_speed", self.readout_speed, speeds, str(status.readout_speed)),
            ("mask", self.mask_choice, status.masks, status.mask),
            ("registration.method", self.registration, get_args(Method), registration.method),
            ("registration.warp", self.warp, (AUTOMATIC, *FIELD_MODES), registration.warp),
            ("reconstruction.method", self.method, ("zonal", "modal"), reconstruction.method),
            ("reconstruction.basis", self.basis, get_args(PupilBasis), reconstruction.basis),
        ):
            mark_wanted(choice, is_wanted=name in wanted)
            choice.show_choice(texts, str(wanted.get(name, chosen) or AUTOMATIC))
        self.refine.setChecked(wanted.get("reconstruction.refine", reconstruction.refine))
        mark_wanted(self.refine, is_wanted="reconstruction.refine" in wanted)
        self.warp.setEnabled(registration.method == "gauss_newton")
        for control in (self.basis, self.pupil_modes):
            control.setEnabled(reconstruction.method == "modal")
        for shown, texts, is_on, colour in (
            (self.light, _light_texts(status), status.is_light_on, theme.LIT),
            (self.sample, ("Sample out", "Sample in"), status.is_sample_in, theme.ACCENT),
        ):
            shown.setText(texts[is_on])
            shown.setChecked(is_on)
            shown.setIcon(theme.lamp(colour if is_on else theme.LINE))
        about_reference = "\n".join(filter(None, (status.reference_note, status.mask_note)))
        self.dark.show_step(status.dark, taken_at(status.dark_note), status.dark_note)
        self.reference.show_step(status.reference, taken_at(status.reference_note), about_reference)
        lattice = status.lattice
        self.lattice.show_step(
            "missing" if lattice is None else "good", "", "" if lattice is None else f"pitch {lattice.pitch_px:.3f} px"
        )

    def show_brightness(self, statistics: FrameStatistics) -> None:
        """Show how bright a frame is."""
        share = statistics.peak / statistics.clip_level
        state: Validity = "good" if share > _DIM and not statistics.is_nearly_full else "doubtful"
        self.auto_exposure.show_step(state, percent(share), "brightest pixel beside full scale; 70 % is best")


class _LightButton(Button):
    """A button that also asks for darkness while its panel is disabled: a bench is opened."""

    def click(self) -> None:
        """Press the button."""
        if self.isEnabled():
            super().click()
        elif self.isEnabledTo(self.parentWidget()):  # it is not disabled itself, as by a replay
            self.clicked.emit(False)


def _modes_range(bench: Bench) -> Range:
    """Numbers of pupil modes: at most one for each lenslet, or what is in force; the lowest stands for automatic."""
    lenslets = bench.sensor.lenslet_rows * bench.sensor.lenslet_columns
    return Range(PUPIL_MODES.start - 1, max(min(lenslets, PUPIL_MODES[-1]), bench.reconstruction.pupil_modes or 0))


def _light_texts(status: Status) -> tuple[str, str]:
    """Texts for a light that is off and on; of a manual one only what a person has said is known."""
    return ("Light\nnoted off", "Light\nby hand") if status.bench.has_manual_light else ("Light off", "Light on")


def _named(name: str, *controls: Item) -> QHBoxLayout:
    return row(label(name, "dim"), *controls, spacing=_GAP)


def _choice(tool_tip: str, chosen: Slot) -> Choice:
    choice, send = Choice(), chosen if callable(chosen) else chosen.emit
    choice.activated.connect(lambda index: send(choice.itemData(index)))
    choice.setToolTip(tool_tip)
    choice.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
    return choice

"""The controls panel: light, devices, calibration and refinement; all values are in SI units."""

from collections.abc import Callable, Mapping
from functools import partial

from PyQt6.QtCore import QEvent, QSize, pyqtSignal
from PyQt6.QtWidgets import QAbstractButton, QAbstractSpinBox, QComboBox, QGridLayout, QSizePolicy, QWidget

from app.acquisition.dark_reference_store import Validity
from app.acquisition.instrument import Commands, Status
from app.acquisition.start_up import DARK, EXPOSURE, LATTICE, REFERENCE
from app.bench.settings_form import name_of
from app.gui.panels.panel import DisplayState, Entries, Panel
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button, Choice, Refusal, Slot, Toggle
from app.gui.widgets.fields import NumberField
from app.gui.widgets.layouts import Scrolled, captioned, column, row, row_of
from app.gui.widgets.presentation import percent
from app.gui.widgets.texts import ElidedLabel
from app.measurement.auto_exposure import FILL
from app.measurement.averages import AVERAGED_FRAMES, FRAMES
from drivers.interface import Range
from reconstruction.settings import FIELD_MODES

_GAP_PX = 4  # between controls
_DIM = 0.3  # share of full scale below which noise matters
_REFINE = "reconstruction.refine"


class ControlsPanel(Panel):
    """Emits the user's requests and shows the status of the instrument."""

    title, is_tab = "Controls", False
    requested = pyqtSignal(str, object)  # name of a routine, and its argument
    wanted = pyqtSignal(object, object)  # method that changes a device, or name of another setting, and the value

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        self._is_running, self._has_devices = False, True
        self._make_devices()
        self._make_calibration()
        about = "Output amplifier; a change restarts the camera"
        self.choices = {"amplifier": _choice(about, self._want(Commands.set_amplifier))}
        about = "Readout speed: faster is noisier; a change restarts the camera"
        self.choices["readout_speed"] = _choice(about, self._want(Commands.set_readout_speed))
        about = "Mask in front of the light; a new mask needs a new reference (R)"
        self.choices["mask"] = _choice(about, self._want("mask"))
        about = "Correct systematic errors by a simulation of your bench; the verdict has the correction's age (F)"
        self.refine = Toggle("Refine off", about, self._want(_REFINE))
        self.method = ElidedLabel("dim", "Method", lines=2)
        about = "Choose registration, warp and modes in the settings of the bench"
        self.change = Button("Change…", about, self._ask("method"))
        self.change.setAccessibleName("Change the method")
        self.region = ElidedLabel("dim", "Region")
        lines = QGridLayout()
        lines.setSpacing(_GAP_PX)
        for at, control in enumerate(
            (
                *(self.light, captioned("Current (mA)", self.current)),
                *(self.lattice, self.auto_exposure, self.dark, self.reference, self.calibrate, self.refine),
                *(captioned("Exposure (ms)", self.exposure), captioned("Gain", self.em_gain)),
                *(captioned("Frames in a mean", self.frames), captioned("Mask", self.choices["mask"])),
                *(captioned("Amplifier", self.choices["amplifier"]), captioned("Speed", self.choices["readout_speed"])),
            )
        ):
            lines.addWidget(control, *divmod(at, 2))
        for side in range(2):
            lines.setColumnStretch(side, 1)
        self.header = row_of(self.start, self.sample)
        expert = row((self.region, 1), self.sensor_region), row((self.method, 1), self.change)
        contents = QWidget()
        column(lines, *expert, (QWidget(), 1), spacing=_GAP_PX, parent=contents)
        column((Scrolled(contents), 1), parent=self)  # they are higher than a small screen
        self._refusal = Refusal(self.header, self)
        self.setEnabled(False)

    def _make_devices(self) -> None:
        about = "Start or stop taking frames (Space)"
        self.start = Button("Start", about, lambda: self.wanted.emit(Commands.set_running, not self._is_running))
        about = "Choose the sensor region and the binning (P)"
        self.sensor_region = Button("Change…", about, self._ask("sensor_region"))
        self.sensor_region.setAccessibleName("Change the sensor region")
        self.exposure = NumberField(name="Exposure", unit="ms", decimals=3, tool_tip="Exposure time in force (E)")
        about = "Electron-multiplying gain: more signal above the read noise"
        self.em_gain = NumberField(name="Gain", decimals=1, tool_tip=about)
        self.current = NumberField(name="Current", unit="mA", decimals=1, tool_tip="Current of the light while on (C)")
        self.exposure.entered.connect(self._want(Commands.set_exposure_s))
        self.em_gain.entered.connect(self._want(Commands.set_em_gain))
        self.current.entered.connect(self._want(Commands.set_current_a))
        self.light = _LightButton("Light off", "Switch the light (L)", self._ask("light"))
        self.light.setProperty("role", "light")
        self.light.setIconSize(QSize(20, 20))
        self.light.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
        self.sample = Toggle(
            "Sample out", "Move the sample into or out of the beam (S)", self._want(Commands.set_sample_in)
        )

    def _make_calibration(self) -> None:
        self.frames = NumberField(name="Frames", tool_tip="Number of frames averaged into a dark or a reference")
        self.frames.show_value(FRAMES, Range(AVERAGED_FRAMES.start, AVERAGED_FRAMES[-1]))
        about = "Find the lenslets in the reference and propose a lattice (N)"
        self.lattice = StepButton(f"1 {LATTICE.title}", about, self._ask("lattice"), widest="")
        about = f"{EXPOSURE.explanation} (X)"
        self.auto_exposure = StepButton(f"2 {EXPOSURE.title}", about, self._ask("auto_exposure"))
        self.dark = StepButton(f"3 {DARK.title}", f"{DARK.explanation} (D)", lambda: self._ask_average("dark"))
        about = f"{REFERENCE.explanation} (R)"
        self.reference = StepButton(f"4 {REFERENCE.title}", about, lambda: self._ask_average("reference"))
        about = "Find lattice and exposure, take dark and reference, with an explanation of each step (Ctrl+K)"
        self.calibrate = Button("Calibrate…", about, lambda: self._ask_average("calibration"))

    def menu_entries(self) -> Mapping[str, Entries]:
        return {
            "&Bench": (
                ("Start or stop the camera", "Space", self.start),
                ("Light on", "L", self.light),
                ("Sample in", "S", self.sample),
                ("Edit the exposure", "E", self.exposure.edit),
                ("Edit the current", "C", self.current.edit),
                ("Choose the sensor region…", "P", self.sensor_region),
                ("Refinement", "F", self.refine),
                None,
                ("Calibrate step by step…", "Ctrl+K", self.calibrate),
                ("Find the exposure", "X", self.auto_exposure),
                ("Take a dark", "D", self.dark),
                ("Take a reference", "R", self.reference),
                ("Find the lattice", "N", self.lattice),
            )
        }

    def _ask(self, name: str) -> Callable[[object], object]:
        return partial(self.requested.emit, name)

    def _want(self, setting: object) -> Callable[[object], object]:
        return partial(self.wanted.emit, setting)

    def _ask_average(self, name: str) -> None:
        if self.frames.commit():  # the button does not take the focus from it
            self.requested.emit(name, round(self.frames.value()))

    def show_switching_off(self) -> None:
        self.light.setText("Switching off\N{HORIZONTAL ELLIPSIS}")

    def show_unreached_light(self) -> None:
        """Show that nothing is known of the light, and nothing can switch it."""
        self.light.setText("Light not reached")
        self.light.setIcon(theme.validity_lamp("doubtful"))

    def changeEvent(self, event: QEvent | None) -> None:  # noqa: N802 - Qt's name
        """Let the buttons of the header follow the panel."""
        if event is not None and event.type() == QEvent.Type.EnabledChange and self.header is not None:
            self.header.setEnabled(self.isEnabled())
        super().changeEvent(event)

    def refuse(self, reason: str, *, is_replay: bool = False) -> None:
        """Disable, for a reason, what this window cannot do; enable all, until the next status, without one.

        A replay has no devices, and a window that only watches can switch the light off.
        """
        self._has_devices, self._refusal.reason = not is_replay, reason
        self.start.setVisible(not is_replay)
        usable = {self.refine, self.start} if is_replay else {self.light}
        for control in (self.start, self.sample, *self.findChildren((QAbstractButton, QAbstractSpinBox, QComboBox))):
            if control not in usable:
                control.setEnabled(not reason)

    def show_status(self, status: Status) -> None:
        """Show the status and wanted settings; a focused field changes only when all commands are finished."""
        self.start.setText("Stop" if status.is_running else "Start")
        self.start.setIcon(theme.start_or_stop(is_running=status.is_running))
        self._is_running = status.is_running
        self.region.setText(f"Region: {status.capabilities.rows} x {status.capabilities.columns} px")
        self._show_fields(status)
        self._show_choices(status)
        self._show_switches(status)
        dark, reference = status.dark, status.reference
        about_reference = "\n".join(filter(None, (reference.note, status.mask_note)))
        self.dark.show_step(dark.validity, dark.taken_at, dark.note)
        self.reference.show_step(reference.validity, reference.taken_at, about_reference)
        pitch = "" if status.lattice is None else f"pitch {status.lattice.pitch_text(3)}"
        self.lattice.show_step("good" if pitch else "missing", "", pitch)
        if self._refusal.reason:
            self.refuse(self._refusal.reason, is_replay=not self._has_devices)  # of what the status has enabled

    def _show_fields(self, status: Status) -> None:
        allowed, wanted = status.capabilities, self.shown.wanted
        for setter, field, value, interval in (
            (Commands.set_exposure_s, self.exposure, status.exposure_s, allowed.exposure_range_s),
            (Commands.set_em_gain, self.em_gain, status.em_gain, allowed.em_gain_range),
            (Commands.set_current_a, self.current, status.current_a, status.current_range_a),
        ):
            theme.restyle(field, "wanted", setter in wanted)
            if self.shown.is_settled or not field.hasFocus():
                field.show_value(wanted.get(setter, value) or 0, interval)
        self.current.setEnabled(status.current_range_a.maximum > status.current_range_a.minimum)
        self.em_gain.setEnabled(allowed.em_gain_range.maximum > allowed.em_gain_range.minimum)

    def _show_choices(self, status: Status) -> None:
        allowed, wanted = status.capabilities, self.shown.wanted
        amplifier, speed, mask = self.choices.values()
        for setting, choice, values, chosen in (
            (Commands.set_amplifier, amplifier, allowed.amplifiers, status.amplifier),
            (Commands.set_readout_speed, speed, allowed.readout_speeds, status.readout_speed),
            ("mask", mask, status.masks, status.mask),
        ):
            theme.restyle(choice, "wanted", setting in wanted)
            choice.show_choice(values, wanted.get(setting, chosen))
            if (around := choice.parentWidget()) is not None:
                around.setVisible(len(values) > 1)  # there is nothing to choose

    def _show_switches(self, status: Status) -> None:
        wanted, refine = self.shown.wanted, status.bench.reconstruction.refine
        is_refined = wanted.get(_REFINE, refine)
        theme.restyle(self.refine, "wanted", _REFINE in wanted)
        # Of a manual light only what a person has said is known.
        lights = ("Light noted off", "Light by hand") if status.bench.has_manual_light else ("Light off", "Light on")
        if not self._has_devices:
            lights = ("Light was off", "Light was on")
        for shown, names, is_on, colour in (
            (self.light, lights, status.is_light_on, theme.LIT),
            (self.sample, ("Sample out", "Sample in"), status.is_sample_in, theme.ACCENT),
            (self.refine, ("Refine off", "Refine on"), is_refined, theme.ACCENT),
        ):
            shown.setText(names[is_on])
            shown.setChecked(is_on and (self._has_devices or shown is self.refine))  # a pressed light has a red edge
            shown.setIcon(theme.lamp(colour if is_on else theme.LINE))

    def show_numbers(self) -> None:
        self.method.setText(self._method_in_words())
        statistics = self.shown.statistics
        if self.shown.measurement is None or statistics is None:
            return
        share = statistics.peak / statistics.clip_level
        state: Validity = "good" if share > _DIM and not statistics.is_nearly_full else "doubtful"
        about = f"brightest pixel, % of full scale; aim for {percent(FILL)}"
        self.auto_exposure.show_step(state, percent(share), about)

    def _method_in_words(self) -> str:
        """Name the method, and warp and modes, also those that are chosen automatically."""
        status, wavefront = self.shown.status, self.shown.wavefront
        if status is None:
            return "Method"
        parts = [name_of(status.method or status.bench.registration.named_method)]
        if wavefront is not None:
            count, coefficients = wavefront.displacement.modes.count, wavefront.coefficients
            parts += [name for name, modes in FIELD_MODES.items() if modes == count]
            parts += [] if coefficients is None else [f"{len(coefficients)} modes"]
        return f"Method: {', '.join(parts)}"


class StepButton(Button):
    """A step of the calibration: its name, its state as a lamp, and its time or value."""

    def __init__(self, name: str, tool_tip: str, clicked: Slot, *, widest: str = "00:00") -> None:
        """Leave space for the `widest` time or value."""
        super().__init__(name, tool_tip, clicked)
        self._name, self._about = name, tool_tip
        self._shown: tuple[Validity, str, str] = ("missing", "", "")
        self.setProperty("role", "step")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        if widest:
            self.ensurePolished()
            self.show_step("missing", widest, "")
            self.setMinimumWidth(self.sizeHint().width())
        self.show_step("missing", "", "no frame yet")
        theme.follow(self, self._light_lamp)

    def show_step(self, validity: Validity, state: str, note: str) -> None:
        if (validity, state, note) == self._shown:
            return
        self._shown = validity, state, note
        self.setText(f"{self._name}  {state}" if state else self._name)
        self._light_lamp()
        self.setToolTip(f"{self._about}\n\n{validity.capitalize()}: {note}" if note else self._about)

    def _light_lamp(self) -> None:
        self.setIcon(theme.validity_lamp(self._shown[0]))


class _LightButton(Toggle):
    """A button that also asks for darkness while its panel is disabled: a bench is opened."""

    def click(self) -> None:
        """Press the button, as menu and key do."""
        if self.isEnabled():
            super().click()
        elif self.isEnabledTo(self.parentWidget()):  # it is not disabled itself, as by a replay
            self.clicked.emit(False)


def _choice(tool_tip: str, chosen: Callable[[object], object]) -> Choice:
    choice = Choice(tool_tip)
    choice.activated.connect(lambda index: chosen(choice.itemData(index)))
    choice.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
    return choice

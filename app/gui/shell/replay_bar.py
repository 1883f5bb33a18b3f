"""The replay bar: play, step, position and speed of a recording in place of the devices."""

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial

import numpy as np
import pyqtgraph as pg
from PyQt6.QtCore import QEvent, QSignalBlocker, Qt
from PyQt6.QtGui import QHelpEvent, QMouseEvent, QPainter, QPaintEvent, QPen
from PyQt6.QtWidgets import QFrame, QSlider, QToolTip

from app.acquisition.instrument import Status
from app.gui.panels.controls import ControlsPanel
from app.gui.shell.menus import listing_menu
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button, Choice
from app.gui.widgets.file_work import FileWork
from app.gui.widgets.layouts import fill_strip
from app.gui.widgets.texts import label
from app.measurement.measurement import Measurement
from app.recording.recover import frames_in_words
from app.results.player import Overview, Player

_NAMES = ("\N{VULGAR FRACTION ONE QUARTER}", "\N{VULGAR FRACTION ONE HALF}", "1", "2", "4")
_SPEEDS = {f"\N{MULTIPLICATION SIGN} {name}": 0.25 * 2**index for index, name in enumerate(_NAMES)}
_COLOURS = {"bad": theme.RED, "saturated": theme.AMBER, "dark": theme.DIM}  # of marks
_POINTS = 1000  # of a curve, and places of marks
_MARGIN_PX = 3
_MARK_PX = 5  # height
_MOST_LISTED = 40  # frames with a fault
_RECORDED = "This window plays a recording: no device belongs to it"
_ABOUT = (
    "Click or drag: go to a frame. Blue: RMS of each frame as it was recorded; green: number of valid lenslets.\n"
    "Marks: red for bad frames, amber for saturated, grey for dark ones."
)


class Timeline(QSlider):
    """Position in a recording over its time, with curves of RMS and valid lenslets, and marks."""

    def __init__(self) -> None:
        super().__init__(Qt.Orientation.Horizontal)
        self.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.setToolTip(_ABOUT)
        self.setAccessibleName("Position in the recording")
        self.setMinimumHeight(2 * self.fontMetrics().height())
        self.show_overview(None, frozenset())

    def show_overview(self, overview: Overview | None, damaged: frozenset[int]) -> None:
        """Show the course of a recording, or only its length, and mark `damaged` positions as bad."""
        self.marked, self._overview = damaged, overview
        time_s = np.arange(self.maximum() + 1) if overview is None else overview.time_s
        self._place = time_s / max(float(time_s[-1]), 1e-9)  # of each position, of 1
        kinds = {} if overview is None else {position: kind for position, (kind, _) in overview.faults.items()}
        kinds |= dict.fromkeys(damaged, "bad")
        self._marks = {round(_POINTS * self._place[position]): _COLOURS[kind] for position, kind in kinds.items()}
        self.update()

    def paintEvent(self, _: QPaintEvent | None) -> None:  # noqa: N802 - Qt's name
        painter, height = QPainter(self), self.height() - _MARK_PX - 2
        painter.fillRect(self.rect(), theme.RAISED)
        if self._overview is not None:
            place, valid, rms = self._overview.course(_POINTS)
            most_rad, most_valid = (np.nanmax(of, initial=0) for of in (self._overview.rms_rad, self._overview.valid))
            left = _MARGIN_PX
            for colour, of_1, most in (
                (theme.GREEN, valid, f"{most_valid:.0f} lenslets"),
                (theme.ACCENT, 0.8 * rms, f"RMS to {most_rad:.2g} rad"),
            ):
                painter.setPen(QPen(colour, 1))
                painter.drawText(left, height, most)  # below the curves
                left += self.fontMetrics().horizontalAdvance(f"{most}   ")
                x, y = _MARGIN_PX + self._reach_px * place, height - (height - 2) * of_1
                painter.drawPath(pg.arrayToQPath(x, y, connect="finite"))
        for place, colour in self._marks.items():
            x = _MARGIN_PX + round(self._reach_px * place / _POINTS)
            painter.fillRect(x - 1, self.height() - _MARK_PX, 3, _MARK_PX, colour)
        x = _MARGIN_PX + round(self._reach_px * self._place[self.value()])
        painter.fillRect(x - 1, 0, 2, self.height(), theme.TEXT)
        if self.hasFocus():
            painter.setPen(theme.ACCENT)
            painter.drawRect(self.rect().adjusted(0, 0, -1, -1))

    @property
    def _reach_px(self) -> int:
        return self.width() - 2 * _MARGIN_PX

    def mousePressEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        if event is not None and event.button() == Qt.MouseButton.LeftButton:
            self.setSliderDown(True)
            self.mouseMoveEvent(event)

    def mouseMoveEvent(self, event: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        if event is not None and self.isSliderDown():
            self.setValue(self._position_at(event.position().x()))

    def _position_at(self, x_px: float) -> int:
        return int(np.abs(self._place - (x_px - _MARGIN_PX) / self._reach_px).argmin())

    def event(self, event: QEvent | None) -> bool:
        """Say in the tool tip what was measured of the frame under the pointer."""
        if isinstance(event, QHelpEvent) and event.type() == QEvent.Type.ToolTip and self._overview is not None:
            text = f"{self._overview.at(self._position_at(event.pos().x()))}\n\n{_ABOUT}"
            QToolTip.showText(event.globalPos(), text, self)
            return True
        return super().event(event)

    def mouseReleaseEvent(self, _: QMouseEvent | None) -> None:  # noqa: N802 - Qt's name
        self.setSliderDown(False)


class ReplayBar(QFrame):
    """Moves through the frames of a player, under a drag to the newest position only; hidden without one."""

    def __init__(self, controls: ControlsPanel, warn: Callable[[str], object]) -> None:
        """Play and stop with the start button of the `controls`, whose devices are disabled; `warn` of lost frames."""
        super().__init__()
        self.setProperty("role", "strip")
        self._player: Player | None = None
        self._controls, self._warn = controls, warn
        self._wanted: int | None = None
        self._target, self._direction = 0, 1  # of the last move
        self._moving: Future[None] | None = None
        self.badge = label("REPLAY", "badge")
        self.play = Button("Play", "Play or pause (Space)", controls.start.click)
        self.back = Button("\N{LEFTWARDS ARROW}", "Previous frame (,)", lambda: self._step(-1))
        self.forth = Button("\N{RIGHTWARDS ARROW}", "Next frame (.)", lambda: self._step(1))
        self.slider = Timeline()
        self.slider.valueChanged.connect(self._move)
        self.time, self.text = label(""), label("")
        self.time.setMinimumWidth(self.time.fontMetrics().horizontalAdvance("00000.00 s"))
        self.faults = Button("Bad frames", "Frames that are bad, saturated or dark; choose one to see it")
        self.faults.setMenu(listing_menu(self, self._faults))
        self._reading = FileWork(self, warn)
        self._overview: Overview | None = None
        self.speed = Choice("Speed relative to the recording; a slow computer skips frames", _SPEEDS.items())
        self.speed.setCurrentIndex(list(_SPEEDS.values()).index(1.0))
        self.speed.activated.connect(lambda _: self._set_speed())
        steps = self.back, self.play, self.forth
        parts = self.badge, *steps, (self.slider, 1), self.time, self.text, self.faults
        fill_strip(self, *parts, label("Speed", "dim"), self.speed)
        self.use(None)

    def use(self, player: Player | None) -> None:
        """Move through the frames of another player; hide without one."""
        self._player, self._wanted, self._moving = player, None, None
        self._overview, self._controls.shown.replayed = None, None
        self._controls.shown.recording = None if player is None else player.folder
        self._reading.forget()
        self._controls.refuse(_RECORDED * (player is not None), is_replay=player is not None)
        self.setVisible(player is not None)
        for step in (self.back, self.forth):
            step.setEnabled(player is not None)
        if player is None:
            return
        with QSignalBlocker(self.slider):  # it stands where the recording before was
            self.slider.setRange(0, len(player.frames) - 1)
            self.slider.setValue(0)
        self.slider.show_overview(None, frozenset())
        self._reading.run(player.overview, self._show_overview)
        last = player.frames[-1]
        self.text.setMinimumWidth(self.text.fontMetrics().horizontalAdvance(f"frame {last} of {last}  "))

    def show_measurement(self, measurement: Measurement | None) -> None:
        """Tell the panels which recorded frame this is, and when it was taken; show its light."""
        player, overview = self._player, self._overview
        position = None if player is None or measurement is None else player.position_of(measurement.frame)
        if player is None or position is None or overview is None:
            return
        self._controls.shown.replayed = f"frame {player.frames[position]}", float(overview.time_s[position])
        self._controls.light.setText(f"Light was {'off' if position in overview.is_dark else 'on'}")

    def show_status(self, status: Status) -> None:
        """Show whether the recording plays."""
        if self._player is not None:
            self.play.setText("Pause" if status.is_running else "Play")
            self.play.setIcon(theme.start_or_stop(is_running=status.is_running))
            self.show_measurement(self._controls.shown.measurement)

    def refresh(self) -> None:
        """Show the position, and go to the wanted one as soon as the last move is done; called at each refresh."""
        player = self._player
        if player is None:
            return
        self._mark_damaged(player)
        if self._moving is not None:
            if not self._moving.done():
                return
            moved, self._moving = self._moving, None
            try:
                moved.result()
            except Exception as error:  # noqa: BLE001 - every error is shown
                self._mark_damaged(player)
                if self._target not in self.slider.marked:
                    self._warn(str(error))
                elif self._wanted is None:
                    self._wanted = self._sound(self._target)
        if self._wanted is not None:
            self._target, self._wanted = self._wanted, None
            self._moving = player.show_frame(self._target)
        elif player.position is not None and not self.slider.isSliderDown():
            with QSignalBlocker(self.slider):
                self.slider.setValue(player.position)
            self._write(player.position)

    def _mark_damaged(self, player: Player) -> None:
        """Say which frames were found damaged, and mark them on the slider."""
        damaged = player.damaged
        if new := sorted(damaged.keys() - self.slider.marked):
            names = frames_in_words([player.frames[position] for position in new])
            self._warn(f"{names} skipped: {damaged[new[-1]]}")
            self.slider.show_overview(self._overview, frozenset(damaged))

    def _show_overview(self, overview: Overview) -> None:
        self._overview = overview
        self.slider.show_overview(overview, self.slider.marked)
        self.faults.setText(f"Bad frames: {len(overview.faults)}")

    def _faults(self) -> Iterator[tuple[str, Callable[[], object]]]:
        """Yield the frames with a fault, and what goes to each."""
        if self._player is not None and self._overview is not None:
            for position, text in self._overview.in_words(self._player.frames)[:_MOST_LISTED]:
                yield text, partial(self.slider.setValue, position)

    def _write(self, position: int) -> None:
        if self._overview is not None:
            self.time.setText(f"{self._overview.time_s[position]:.2f} s")
        if self._player is not None:
            frames = self._player.frames
            self.text.setText(f"frame {frames[position]} of {frames[-1]}")
            first = f"The first is frame {frames[0]}"
            self.text.setToolTip(f"{first}; frames are counted from 0, as in files, messages and --frames")

    def _move(self, position: int) -> None:
        if self._player is not None:
            self._direction = 1 if position >= (self._player.position or 0) else -1  # none before the first frame
            self._wanted = self._sound(position)
            self._write(position)

    def _sound(self, position: int) -> int | None:
        """Return this position, or the next one in the direction of the move without a damaged frame."""
        while position in self.slider.marked:
            position += self._direction
        return position if self.slider.minimum() <= position <= self.slider.maximum() else None

    def _step(self, by: int) -> None:
        self.slider.setValue(self.slider.value() + by)

    def _set_speed(self) -> None:
        if self._player is not None:
            self._player.set_speed(self.speed.currentData())

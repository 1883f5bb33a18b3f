"""The replay bar: play, step, position and speed of a recording in place of the devices."""

from collections.abc import Callable
from concurrent.futures import Future

from PyQt6.QtCore import QSignalBlocker, Qt
from PyQt6.QtGui import QPainter, QPaintEvent
from PyQt6.QtWidgets import QFrame, QSlider, QStyle

from app.acquisition.instrument import Status
from app.gui.panels.controls import ControlsPanel
from app.gui.widgets import theme
from app.gui.widgets.buttons import Button, Choice
from app.gui.widgets.layouts import fill_strip
from app.gui.widgets.texts import label
from app.recording.recover import frames_in_words
from app.results.player import Player

_NAMES = ("\N{VULGAR FRACTION ONE QUARTER}", "\N{VULGAR FRACTION ONE HALF}", "1", "2", "4")
_SPEEDS = {f"\N{MULTIPLICATION SIGN} {name}": 0.25 * 2**index for index, name in enumerate(_NAMES)}


class _Slider(QSlider):
    """Slider with red marks at some of its values."""

    marked: frozenset[int] = frozenset()

    def paintEvent(self, event: QPaintEvent | None) -> None:  # noqa: N802 - Qt's name
        super().paintEvent(event)
        painter, style = QPainter(self), self.style()
        handle = 0 if style is None else style.pixelMetric(QStyle.PixelMetric.PM_SliderLength, None, self)
        for value in self.marked:
            x = QStyle.sliderPositionFromValue(self.minimum(), self.maximum(), value, self.width() - handle)
            painter.fillRect(x + handle // 2 - 1, 0, 2, self.height(), theme.RED)


class ReplayBar(QFrame):
    """Moves through the frames of a player; hidden without one.

    A move stops the replay. While the slider is dragged, only the newest position is shown: reconstruction may be slow.
    """

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
        self.slider = _Slider(Qt.Orientation.Horizontal)
        self.slider.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.slider.setToolTip("Position in the recording")
        self.slider.valueChanged.connect(self._move)
        self.text = label("")
        self.speed = Choice("Speed beside that of the recording; a slow computer skips frames", _SPEEDS.items())
        self.speed.setCurrentIndex(list(_SPEEDS.values()).index(1.0))
        self.speed.activated.connect(lambda _: self._set_speed())
        steps = self.back, self.play, self.forth
        parts = self.badge, *steps, (self.slider, 1), self.text, label("Speed", "dim"), self.speed
        fill_strip(self, *parts)
        self.use(None)

    def use(self, player: Player | None) -> None:
        """Move through the frames of another player; hide without one."""
        if self._player is not None and player is None:
            self._controls.enable_devices(is_enabled=True)
        self._player, self._wanted, self._moving = player, None, None
        self.slider.marked = frozenset()
        self.setVisible(player is not None)
        for step in (self.back, self.forth):
            step.setEnabled(player is not None)
        if player is None:
            return
        self._controls.enable_devices(is_enabled=False)
        with QSignalBlocker(self.slider):  # it stands where the recording before was
            self.slider.setRange(0, len(player.frames) - 1)
            self.slider.setValue(0)
        last = player.frames[-1]
        self.text.setMinimumWidth(self.text.fontMetrics().horizontalAdvance(f"frame {last} of {last} ... {last}  "))

    def show_status(self, status: Status) -> None:
        """Show whether the recording plays; disable the devices, which the status has enabled."""
        if self._player is not None:
            self._controls.enable_devices(is_enabled=False)
            self.play.setText("Pause" if status.is_running else "Play")
            self.play.setIcon(theme.start_or_stop(is_running=status.is_running))

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
            self.slider.marked = frozenset(damaged)
            self.slider.update()

    def _write(self, position: int) -> None:
        if self._player is not None:
            frames = self._player.frames
            self.text.setText(f"frame {frames[position]} of {frames[0]} ... {frames[-1]}")
            self.text.setToolTip("Frames are counted from 0, as in files, messages and --frames")

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

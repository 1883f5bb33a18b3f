"""The open acquisition, its process, the commands that the window sends to it, and the settings that it wants."""

import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from functools import partial
from typing import Any, TypeVar

from PyQt6.QtCore import QObject, QTimer, pyqtSignal
from PyQt6.QtWidgets import QMessageBox, QWidget

from app.acquisition.address import CLOSING_S
from app.acquisition.instrument import Commands, ProcessState, Status
from app.acquisition.remote.connection import Connection, RunningInstrument
from app.acquisition.remote.messages import watching
from app.acquisition.remote.own_connection import OwnConnection
from app.acquisition.start_up import start_up
from app.errors import InputError, RunError
from app.gui.shell.messages import MessageStrip
from app.gui.widgets.timers import REFRESH_MS
from app.measurement.routines import Cancelled
from app.results.player import InstrumentFactory

T = TypeVar("T")
Then = Callable[[Any], object] | None  # receives a result
Otherwise = Callable[[Exception], object] | None
Setter = Callable[..., Future[Any]]  # method of `Commands` that changes a setting of a device
_MASK = "mask"
_MODES = {Commands.set_amplifier, Commands.set_readout_speed}  # they return what else has changed
_SILENT_S = 5.0  # for the end of a process that does not answer
_FRAMES_MS = 500  # between two changes of the bench: they stop the camera
_NOT_ATTACHED = "this window runs the instrument itself: svwfs live --attach opens one on another process"
_STARTS = "the instrument is starting: wait until it is reached"


class Controller(QObject):
    """Owns the acquisition; passes results of commands to callbacks, and shows their errors as warnings.

    There is no acquisition before `connect_devices` with an `access`, and another one after each reconnection.
    """

    connected = pyqtSignal()  # another acquisition has started
    question_closed = pyqtSignal()  # it was answered, or belongs to a closed acquisition

    def __init__(self, messages: MessageStrip) -> None:
        super().__init__()
        self.messages = messages
        self.access: InstrumentFactory | None = None  # of the next connection
        self.acquisition: RunningInstrument | None = None
        self.is_stuck = False  # whether the worker did not end on `close`
        self._pending: list[tuple[Future[Any], Then, Otherwise]] = []
        messages.answered.connect(self.question_closed)  # a lambda would keep the closed window
        messages.cancel_requested.connect(self.cancel)

    @property
    def status(self) -> Status | None:
        """Status of the instrument; None until the devices are open."""
        return None if self.acquisition is None else self.acquisition.status

    @property
    def is_attached(self) -> bool:
        """True if the instrument runs in a process that this window has not started."""
        return self._process is not None and not isinstance(self._process, OwnConnection)

    @property
    def is_silent(self) -> bool:
        return self._process is not None and self._process.is_silent

    @property
    def is_lost(self) -> bool:
        """True if the instrument's process has died, and nothing more is known of its devices."""
        return self._process is not None and self._process.is_lost

    @property
    def left(self) -> str:
        """Say that the instrument continues, or why it has ended; empty if it ends with the window."""
        return "" if (on := self._process) is None else on.loss or "the instrument keeps running" * on.goes_on

    @property
    def _process(self) -> Connection | None:
        """The acquisition if it is, or will be, in another process."""
        return self.acquisition if isinstance(self.acquisition, Connection) else None

    @property
    def connection(self) -> Connection | None:
        """The connection to the instrument's process, while there is one."""
        return self._process if self._process is not None and self._process.is_reached else None

    @property
    def may_take_control(self) -> bool:
        connection = self.connection
        return connection is not None and not connection.has_control and not connection.is_silent

    @property
    def notice(self) -> str:
        """The reason that commands are refused; empty if they are not."""
        connection = self.connection
        if connection is not None and connection.is_silent:
            return f"the instrument's process {connection.address.process} does not answer: if that lasts, end it"
        return "" if connection is None or connection.has_control else watching(connection.controller)

    @property
    def processes(self) -> tuple[ProcessState, ...]:
        return () if self.acquisition is None else self.acquisition.processes

    @property
    def about_processes(self) -> str:
        """Lines: the state of each process of the instrument, and its clients."""
        lines = [f"{each.name}: process {each.pid}, {each.condition}" for each in self.processes]
        if (process := self._process) is not None:
            has_clients = process.is_alive and self.processes[0].condition != "gone"
            lines += [f"connected: {', '.join(process.clients)}"] * has_clients
        return "\n".join(lines)

    @property
    def trouble(self) -> str:
        """The process that is not alive, and its state; empty if all are."""
        return next((f"{each.name} {each.condition}" for each in self.processes if each.condition != "alive"), "")

    @property
    def failure(self) -> str:
        """Reason why the acquisition ended by itself, else empty."""
        return "" if self.acquisition is None else self.acquisition.failure

    @property
    def error(self) -> InputError | RunError:
        """The failure as the error of a command."""
        error = None if self.acquisition is None else self.acquisition.error
        return error if isinstance(error, InputError | RunError) else RunError(self.failure)

    @property
    def is_settled(self) -> bool:
        """True if all commands are finished and their results were passed on."""
        return not self._pending

    @property
    def is_idle(self) -> bool:
        return all(future.done() for future, _, _ in self._pending)

    def connect_devices(self, *, is_lit: bool) -> None:
        """Start an acquisition of `access`, if any, and close the one before; it stays after a `RunError`."""
        if self.access is None:
            return
        made = self.access.make()
        before, self.acquisition = self.acquisition, made
        if before is not None:
            before.close()
        self.question_closed.emit()
        made.start()
        self.connected.emit()
        begin = self.access.begin if is_lit or self.is_attached else partial(start_up, is_lit=False)
        self._pending = [(future, None, None) for future in begin(made)]

    def close(self, meanwhile: Callable[[], object]) -> None:
        """Turn the light off at once, close the devices, and call `meanwhile` at 25 Hz until that is done."""
        if self.acquisition is None:
            return
        self.acquisition.begin_close()
        began_s = time.monotonic()
        while self.acquisition.is_alive and time.monotonic() < began_s + (_SILENT_S if self.is_silent else CLOSING_S):
            self.acquisition.close(timeout_s=REFRESH_MS / 1e3)
            meanwhile()
        self.is_stuck = self.acquisition.is_alive

    def send(
        self, submit: Callable[[RunningInstrument], Future[T]], then: Then = None, otherwise: Otherwise = None
    ) -> Future[T] | None:
        """Send a command, if there is an acquisition; `then` receives its result, `otherwise` its error."""
        return None if self.acquisition is None else self.follow(submit(self.acquisition), then, otherwise)

    def follow(self, future: Future[T], then: Then, otherwise: Otherwise) -> Future[T]:
        """Pass on the result of a command that was sent; see `send`."""
        self.messages.clear_notice()
        self._pending.append((future, then, otherwise))
        return future

    def cancel(self) -> None:
        if self.acquisition is not None:
            future = self.acquisition.cancel()
            if self.acquisition.activity.text:  # else there is nothing to end: a refusal need not be told
                self._pending.append((future, None, None))

    def take_control(self) -> None:
        if (connection := self.connection) is None:
            self.messages.warn(self.failure or (_NOT_ATTACHED if self._process is None else _STARTS))
        else:
            self.send(lambda _: connection.take_control())

    def ask_to_leave(self, then: Callable[[], object], parent: QWidget) -> bool:
        """Ask if the instrument continues, as another client's does, and call `then`; False if it ends here."""
        if (connection := self.connection) is None:
            return False
        if connection.is_of_another:
            then()
            return True
        state = connection.recording
        recording = state.folder.name if state is not None and state.stage == "recording" else ""
        recorded = f"recording {recording} continues; Stop ends it" if recording else "nothing is recorded"
        box = QMessageBox(parent)
        box.setIcon(QMessageBox.Icon.Question)
        box.setWindowTitle("svwfs")
        box.setText("Keep the instrument running without this window?")
        box.setInformativeText(f"While it runs, the light stays as it is, and {recorded}.")
        goes_on = box.addButton("Keep running", QMessageBox.ButtonRole.AcceptRole)
        ends = box.addButton("Stop instrument", QMessageBox.ButtonRole.DestructiveRole)
        cancel, is_own = box.addButton(QMessageBox.StandardButton.Cancel), not self.is_attached
        box.setDefaultButton(cancel if recording else ends if is_own else goes_on)
        box.exec()
        if box.clickedButton() is ends and is_own:
            return False
        if box.clickedButton() is ends:
            self.send(lambda _: connection.end(), lambda _: then(), lambda _: None)
        elif box.clickedButton() is goes_on:
            connection.goes_on = True
            then()
        return True

    def poll(self) -> bool:
        """Pass on the results of finished commands; return whether there were any."""
        done = [pending for pending in self._pending if pending[0].done()]
        self._pending = [pending for pending in self._pending if pending not in done]
        for future, then, otherwise in done:
            try:
                result = future.result()
            except Exception as error:  # noqa: BLE001 - every error is shown
                self.messages.warn("cancelled" if isinstance(error, Cancelled | CancelledError) else str(error))
                if otherwise is not None:
                    otherwise(error)
            else:
                if then is not None:
                    then(result)
        return bool(done)


class SettingsControl:
    """Sends what is wanted: one command at a time for each setting of a device, and one for the bench.

    Of the values that come meanwhile, the last is sent next; changes of the bench are joined into one command.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._sent: dict[Setter, Any] = {}  # values under way
        self._changes: list[tuple[str, Any]] = []  # of the next command of the bench
        self._then: Then = None  # receives its result
        self._is_changing = False  # whether a command of the bench is under way
        self.wanted: dict[str | Setter, Any] = {}  # values that are not in force yet
        controller.connected.connect(self._restart)

    def _restart(self) -> None:
        for each in (self._sent, self.wanted, self._changes):
            each.clear()
        self._is_changing = False

    def want(self, setting: str | Setter, value: Any) -> None:
        """Change a setting of a device by its setter, the mask, or a setting of the bench by its name "section.key"."""
        self.wanted[setting] = value
        if isinstance(setting, str):
            self.change((setting, value))
        elif setting not in self._sent:
            self._send(setting)

    def _send(self, setter: Setter) -> None:
        value = self._sent[setter] = self.wanted[setter]
        then = self._controller.messages.warn if setter in _MODES else None
        future = getattr(self._controller.acquisition, setter.__name__)(value)
        self._controller.follow(future, partial(self._end, setter, then), partial(self._end, setter, None))

    def _end(self, setter: Setter, then: Then, result: object) -> None:
        if then is not None:
            then(result)
        if self.wanted[setter] != self._sent.pop(setter):
            self._send(setter)
        else:
            del self.wanted[setter]

    def change(self, *changes: tuple[str, Any], then: Then = None) -> None:
        """Change mask or settings of the open bench by `Instrument.change_settings`; devices stay open."""
        self._changes += changes
        self._then = then or self._then
        if not self._is_changing:
            self._send_changes()

    def _send_changes(self) -> None:
        """Send one command for all changes, so that the reconstruction is prepared once."""
        self._is_changing = bool(self._changes)
        if not self._is_changing:
            self.wanted = {setting: value for setting, value in self.wanted.items() if not isinstance(setting, str)}
            return
        of_bench, mask = [change for change in self._changes if change[0] != _MASK], dict(self._changes).get(_MASK)
        then, self._changes, self._then = self._then, [], None
        self._controller.send(
            lambda to: to.change_settings(of_bench, mask),
            partial(self._end_changes, then),
            partial(self._end_changes, None),
        )

    def _end_changes(self, then: Then, result: object) -> None:
        if then is not None:
            then(result)
        if self._changes:
            QTimer.singleShot(_FRAMES_MS, self._send_changes)
        else:
            self._send_changes()

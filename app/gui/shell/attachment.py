"""The instrument in a process of its own: who controls it, and whether it goes on."""

from collections.abc import Callable

from PyQt6.QtWidgets import QMessageBox, QWidget

from app.acquisition.instrument import ProcessState
from app.acquisition.remote.connection import Connection
from app.acquisition.remote.messages import watching
from app.acquisition.remote.own_instrument import OwnConnection
from app.gui.shell.controller import Controller

_NOT_ATTACHED = "this window runs the instrument itself: svwfs live --attach opens one on another process"
_OVERTAKEN = "frames overtaken: replaced by the instrument before, or while, this window read them"
_STARTS = "the instrument is starting: wait until it is reached"


class Attachment:
    """Commands about the process of the instrument, if that is not this one."""

    def __init__(self, controller: Controller, parent: QWidget) -> None:
        self._controller, self._parent = controller, parent

    @property
    def connection(self) -> Connection | None:
        """The connection to the instrument's process, while there is one."""
        acquisition = self._controller.acquisition
        return acquisition if isinstance(acquisition, Connection) and acquisition.is_reached else None

    @property
    def _why_none(self) -> str:
        """The reason that there is no connection."""
        is_starting = isinstance(self._controller.acquisition, Connection)
        return self._controller.failure or (_STARTS if is_starting else _NOT_ATTACHED)

    @property
    def may_take_control(self) -> bool:
        """True if this window could take control."""
        connection = self.connection
        return connection is not None and not connection.has_control and not connection.is_silent

    @property
    def notice(self) -> str:
        """The reason that commands are refused; empty if they are not."""
        connection = self.connection
        if connection is not None and connection.is_silent:
            return f"the instrument's process {connection.address.process} does not answer: if that lasts, end it"
        if connection is None or connection.has_control:
            return ""
        return watching(connection.controller)

    @property
    def processes(self) -> str:
        """Lines: the state of each process of the instrument, its clients, and overtaken frames."""
        acquisition = self._controller.acquisition
        processes = self._processes
        lines = [f"{each.name}: process {each.pid}, {each.condition}" for each in processes]
        if isinstance(acquisition, Connection):
            has_clients = acquisition.is_alive and processes[0].condition != "gone"
            lines += [f"connected: {', '.join(acquisition.clients)}"] * has_clients
            lines += [f"{acquisition.overtaken} {_OVERTAKEN}"]
        return "\n".join(lines)

    @property
    def trouble(self) -> str:
        """The process that is not alive, and its state; empty if all are."""
        return next((f"{each.name} {each.condition}" for each in self._processes if each.condition != "alive"), "")

    @property
    def _processes(self) -> tuple[ProcessState, ...]:
        acquisition = self._controller.acquisition
        return () if acquisition is None else acquisition.processes

    def take_control(self) -> None:
        if (connection := self.connection) is None:
            self._controller.messages.warn(self._why_none)
        else:
            self._controller.send(lambda _: connection.take_control())

    def end_instrument(self) -> None:
        if (connection := self.connection) is None:
            self._controller.messages.warn(self._why_none)
        elif connection.is_of_another:
            self._controller.messages.warn(self.notice)
        else:
            self._controller.messages.ask(
                "the instrument stops for everybody: the light goes off, recordings are finished",
                lambda: self._controller.send(lambda _: connection.end()),
                "Stop instrument",
                "Keep running",
                is_destructive=True,
            )

    def ask_to_leave(self, then: Callable[[], object]) -> bool:
        """Ask whether the instrument goes on, and call `then`; return False if it ends with the window.

        An instrument that another client controls goes on.
        """
        if (connection := self.connection) is None:
            return False
        if connection.is_of_another:
            then()
            return True
        box = QMessageBox(self._parent)
        box.setIcon(QMessageBox.Icon.Question)
        box.setWindowTitle("svwfs")
        box.setText("Keep the instrument running without this window?")
        state = connection.recording
        recording = state.folder.name if state is not None and state.stage == "recording" else ""
        recorded = f"recording {recording} goes on, too; else it ends" if recording else "nothing is recorded"
        box.setInformativeText(f"While it runs, the light stays as it is, and {recorded}.")
        goes_on = box.addButton("Keep running", QMessageBox.ButtonRole.AcceptRole)
        ends = box.addButton("Stop instrument", QMessageBox.ButtonRole.DestructiveRole)
        is_own = isinstance(connection, OwnConnection)
        cancel = box.addButton(QMessageBox.StandardButton.Cancel)
        box.setDefaultButton(cancel if recording else ends if is_own else goes_on)
        box.exec()
        if box.clickedButton() is ends and is_own:
            return False
        if box.clickedButton() is ends:
            self._controller.send(lambda _: connection.end(), lambda _: then(), lambda _: None)
        elif box.clickedButton() is goes_on:
            connection.goes_on = True
            then()
        return True

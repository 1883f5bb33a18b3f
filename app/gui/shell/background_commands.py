"""Commands of svwfs in processes beside the window: a report, an export, another window."""

from collections.abc import Callable
from pathlib import Path

from PyQt6.QtCore import QObject, QProcess, QProcessEnvironment
from PyQt6.QtWidgets import QAbstractButton

from app.gui.shell.messages import MessageStrip
from app.gui.widgets.presentation import percent
from app.progress import LINE_START, LINES
from app.run_facts import command_line

_END_MS = 3000


class BackgroundCommands(QObject):
    """Runs commands and says how they ended."""

    def __init__(self, messages: MessageStrip, parent: QObject) -> None:
        super().__init__(parent)
        self._messages = messages

    def start(
        self,
        by: QAbstractButton,
        begin: str,
        *arguments: str | Path,
        end: str,
        then: Callable[[], object] | None = None,
    ) -> None:
        """Run a command to its end; meanwhile its button `by` is grey and shows the progress.

        `begin` and `end` are the messages, `then` is called if it succeeds.
        """
        process, name, errors = QProcess(self), by.text(), list[str]()
        environment = QProcessEnvironment.systemEnvironment()
        environment.insert(LINES, "1")
        process.setProcessEnvironment(environment)
        by.setEnabled(False)

        def read() -> None:
            while process.canReadLine():
                line = bytes(process.readLine().data()).decode(errors="replace").strip()
                if line.startswith(LINE_START):
                    by.setText(f"{name} {percent(float(line.removeprefix(LINE_START)))}")
                elif line:
                    errors.append(line)

        def finish(status: int, how: QProcess.ExitStatus) -> None:
            read()
            process.deleteLater()
            by.setText(name)
            by.setEnabled(True)
            if how is QProcess.ExitStatus.NormalExit and status == 0:
                self._messages.inform(end)
                if then is not None:
                    then()
            else:
                self._messages.alarm(errors[-1].removeprefix("svwfs: ") if errors else f"{begin}: failed")

        process.setReadChannel(QProcess.ProcessChannel.StandardError)
        process.readyReadStandardError.connect(read)
        process.finished.connect(finish)
        self._messages.inform(begin)
        process.start(*command_line(*arguments))

    def start_window(self, *arguments: str | Path) -> None:
        """Open another window, which lives on when this one closes."""
        started, _ = QProcess.startDetached(*command_line("live", *arguments))
        if not started:
            self._messages.warn("another window could not be started")

    def close(self) -> None:
        """End the commands that still run; their output files appear only when they are whole."""
        for process in self.findChildren(QProcess):
            process.blockSignals(True)
            process.terminate()
            if not process.waitForFinished(_END_MS):
                process.kill()
                process.waitForFinished(_END_MS)

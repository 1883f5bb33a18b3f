"""A client's end: the acquisition of another process as if it were in this one.

One thread speaks with the instrument; another one reads its newest frames, see `RemoteFrames`.
"""

import itertools
import math
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeAlias, TypeVar

import zmq
from zmq.utils.monitor import recv_monitor_message

from app.acquisition.address import DYING_S, NAME, Address, clear_abandoned
from app.acquisition.frame_path import Sink
from app.acquisition.instrument import Activity, Commands, Instrument, ProcessState, Status
from app.acquisition.remote.frames import RemoteFrames
from app.acquisition.remote.messages import Answer, Bye, Command, Hello, NewStatus, State
from app.acquisition.serialization import MOST_BYTES, Message, encoded, unpacked
from app.acquisition.wakeup_pipe import WakeupPipe
from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from app.errors import RunError
from app.measurement.measurement import FrameTotals, Measurement
from app.recording.recorder import RecordingState
from app.timing import Timings
from drivers.errors import BadValue
from reconstruction.runtime.child_process import Condition

_COUNT = itertools.count(1)  # of connections of this process

T = TypeVar("T")
P = ParamSpec("P")

_ALIVE_S = 1.0  # between two signs of life
_SILENT_S = 2.0  # after which the instrument counts as frozen
_TICK_MS = 250  # for what has a time limit
_LINGER_MS = 200  # for the last messages
ANSWER_S = 5.0  # for a sign of life after a command, and for the first state
_PULSE_S = 1.0  # in which a sign of life comes from an instrument that lives
_SHOWN_S = 0.04  # between two measurements for a mailbox: as often as a window shows one


class PendingCommands:
    """Takes commands from any thread, for the one that sends them."""

    def __init__(self, notify: Callable[[], object]) -> None:
        """`notify` wakes the sender."""
        self._notify = notify
        self._refusal: Exception | None = None  # of all commands, once closed
        self._numbers, self._lock = itertools.count(1), threading.Lock()
        self._waiting: list[Command] = []
        self._unanswered: dict[int, tuple[Future[Any], float]] = {}  # with the time when it was sent

    def submit(
        self, command: Callable[Concatenate[Instrument, P], T], /, *arguments: P.args, **named: P.kwargs
    ) -> Future[T]:
        """Take a command that is a method of the instrument."""
        return self.add(command.__name__, *arguments, **named)

    def add(self, request: str, /, *arguments: Any, **named: Any) -> Future[Any]:
        """Take a command and return its future; relative paths are those of this process."""
        arguments = tuple(each.absolute() if isinstance(each, Path) else each for each in arguments)
        future: Future[Any] = Future()
        future.set_running_or_notify_cancel()  # what is sent cannot be called back
        command = Command(next(self._numbers), request, arguments, named)
        try:
            if Message(command).nbytes > MOST_BYTES:
                raise BadValue(f"{request}: this is too large to be sent to the instrument")  # noqa: TRY301 - as others
        except (BadValue, RunError) as refusal:
            future.set_exception(refusal)
            return future
        with self._lock:
            if self._refusal is None:
                self._unanswered[command.number] = future, math.inf
                self._waiting.append(command)
                self._notify()
                return future
        future.set_exception(self._refusal)
        return future

    def take(self) -> list[Command]:
        """Return the commands to send now; each must begin before it is given up here."""
        now_s = time.monotonic()
        with self._lock:
            taken, self._waiting = self._waiting, []
            for command in taken:
                self._unanswered[command.number] = self._unanswered[command.number][0], now_s
        return [replace(command, until_s=now_s + ANSWER_S - _PULSE_S) for command in taken]

    def note_answer(self, answer: Answer) -> None:
        """Resolve the future of a command."""
        future, _ = self._unanswered.pop(answer.number, (None, 0.0))
        if future is not None and answer.error is None:
            future.set_result(answer.result)
        elif future is not None:
            future.set_exception(answer.error)

    def give_up_lost(self, heard_s: float) -> None:
        """Fail the commands after which the instrument, heard last at a time, has given no sign of life."""
        for number, (future, sent_s) in list(self._unanswered.items()):
            if time.monotonic() > sent_s + ANSWER_S and heard_s < sent_s + _PULSE_S:
                del self._unanswered[number]
                future.set_exception(RunError("the instrument does not answer"))

    def close(self, why: Exception) -> None:
        """Fail all commands without an answer, and take none any more."""
        with self._lock:
            left, self._unanswered, self._refusal = list(self._unanswered.values()), {}, why
        for future, _ in left:
            future.set_exception(why)


def reach(what: str, name: str = NAME, *, sinks: tuple[Sink, ...] = (), takes_control: bool = True) -> "Connection":
    """Connect to the instrument of a name, and wait for its state; `RunError` if none answers."""
    connection = Connection(what, Address.of(name), sinks, takes_control=takes_control)
    connection.wait()
    return connection


def switch_light_off(name: str) -> None:
    """Switch off the light of the instrument of a name, whoever has control; `RunError` if it does not answer."""
    connection = reach("light off", name, takes_control=False)
    try:
        connection.switch_light_off().result()
    finally:
        connection.close()


def _sent(
    request: Callable[Concatenate[Acquisition, P], Future[T]],
) -> Callable[Concatenate["Connection", P], Future[T]]:
    """Return the same request of a connection."""

    def send(connection: "Connection", /, *arguments: P.args, **named: P.kwargs) -> Future[T]:
        return connection.commands.add(request.__name__, *arguments, **named)

    return send


class Connection(Commands):
    """The acquisition of another process; its newest measurements go to the sinks."""

    bench: Bench  # as the instrument was started with; this and what follows are those of its newest state
    status: Status | None = None  # until the devices are open
    counts = FrameTotals()
    recording: RecordingState | None = None
    kept: RecordingState | None = None
    clients: tuple[str, ...] = ()  # names of all
    controller = ""  # name of the client that has control; empty: nobody
    goes_on = True  # whether the instrument does when this connection is closed
    is_lost = False  # whether the instrument's process has died, not been shut down
    _retakes_control = False  # if this client was silent for too long, and nobody else has control

    def __init__(
        self, what: str, address: Address, sinks: tuple[Sink, ...] = (), *, takes_control: bool = True
    ) -> None:
        """Begin to connect, as `what`; with `takes_control`, take control if nobody has it."""
        number = next(_COUNT)
        self.name = f"{what} {os.getpid()}{f'.{number}' * (number > 1)}"
        self.address, self._takes_control = address, takes_control
        self.timings = Timings()
        self._activity = Activity("starting the instrument", may_cancel=False)
        self._is_gone = False  # whether the instrument's process is
        self._has_state, self._closing = threading.Event(), threading.Event()
        self._ended: Exception | None = None
        self._wakeup = WakeupPipe()
        self.commands: PendingCommands = PendingCommands(self._wakeup.notify)
        self._pause_s = 0.0 if sinks else _SHOWN_S
        self.frames = RemoteFrames(partial(self.commands.add, "part"), sinks, self._pause_s)
        self._heard_s = self._hello_due_s = math.inf  # until the instrument is reached
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        self._thread = threading.Thread(target=self._work, name="connection", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Wait until the instrument is reached; close, and raise `RunError`, if it cannot be."""
        self._has_state.wait()
        if self._ended is not None:
            self.close()
            raise self._ended

    @property
    def activity(self) -> Activity:
        """Work other than taking frames; also that the instrument does not answer."""
        if self.is_silent:
            return Activity("the instrument's process does not answer", may_cancel=False)
        return self._activity

    @property
    def processes(self) -> tuple[ProcessState, ...]:
        """State of the instrument's process, and of those that it has started, of which only that one knows."""
        condition: Condition = "gone" if self._is_gone else "frozen" if self.is_silent else "alive"
        started = () if condition != "alive" or self.status is None else self.status.processes
        return ProcessState("instrument", self.address.process, condition), *started

    @property
    def is_reached(self) -> bool:
        """True if the instrument runs, and its state is known."""
        return self.is_alive and self._has_state.is_set() and self._ended is None

    @property
    def is_silent(self) -> bool:
        """True if the instrument's process does not answer: it hangs, or was stopped."""
        return self.is_alive and time.monotonic() > self._heard_s + _SILENT_S

    @property
    def newest(self) -> Measurement | None:
        """The newest measurement."""
        return self.frames.newest

    @property
    def error(self) -> Exception | None:
        """Reason why the instrument ended, or was lost."""
        return None if self._closing.is_set() else self._ended

    @property
    def loss(self) -> str:
        """Reason why the instrument ended, or was lost, also after `close`; empty if it continues."""
        return str(self._ended or "")

    @property
    def failure(self) -> str:
        """`error` in words."""
        return str(self.error or "")

    @property
    def is_alive(self) -> bool:
        """True while the instrument runs and this connection is open."""
        return self._thread.is_alive()

    @property
    def has_control(self) -> bool:
        """True while this client has control: the instrument executes its commands."""
        return self.controller == self.name

    @property
    def is_of_another(self) -> bool:
        """True while another client has control."""
        return self.controller not in {"", self.name}

    def start(self) -> None:
        """Do nothing: the instrument runs."""

    stage_times = _sent(Acquisition.stage_times)
    cancel = _sent(Acquisition.cancel)
    switch_light_off = _sent(Acquisition.switch_light_off)  # watching clients may, too
    show_file = _sent(Acquisition.show_file)
    limit_recording = _sent(Acquisition.limit_recording)
    stop_recording = _sent(Acquisition.stop_recording)
    free_minutes = _sent(Acquisition.free_minutes)

    def take_control(self) -> Future[None]:
        """Take control from the client that has it."""
        return self.commands.add("take_control")

    def shut_down(self) -> Future[None]:
        """End the instrument: light off, devices closed, recording finished."""
        return self.commands.add("shut_down")

    def end(self) -> Future[None]:
        """End the instrument, also if nobody has control."""
        if not self.has_control:
            self.take_control()
        return self.shut_down()

    def begin_close(self) -> None:
        """Leave; the instrument continues."""
        self._closing.set()
        self._wakeup.notify()

    def close(self, timeout_s: float | None = None) -> None:
        """Leave, and wait for that."""
        self.begin_close()
        self._thread.join(timeout_s)
        self.frames.join(timeout_s)

    def _say(self, *messages: object) -> None:
        for message in messages:
            with suppress(zmq.Again):  # the instrument is stopped
                self._socket.send_multipart([self.address.key.encode(), encoded(message)], zmq.NOBLOCK)

    def _work(self) -> None:
        poller = zmq.Poller()
        for each in (self._socket, self._wakeup, self._monitor):
            poller.register(each, zmq.POLLIN)
        try:
            self._reach()
            while not self._closing.is_set() and self._ended is None:
                self._turn(dict(poller.poll(_TICK_MS)))
            self._say(*self.commands.take(), Bye())
        except RunError as error:
            self._ended = error
        except Exception as error:
            self._ended = error
            raise
        finally:
            self.commands.close(self._ended or RunError("the connection to the instrument is closed"))
            self._has_state.set()
            self._socket.disable_monitor()
            self._context.destroy(linger=_LINGER_MS)
            self._wakeup.close()
            self.frames.close()

    def _reach(self) -> None:
        """Say hello to the instrument at `address`; called by the thread."""
        self._socket.connect(self.address.endpoint)
        self._heard_s = time.monotonic()
        self._say_hello()

    def _say_hello(self) -> None:
        self._say(Hello(self.name, self._takes_control, self._pause_s))
        self._takes_control &= self._retakes_control
        self._hello_due_s = time.monotonic() + _ALIVE_S

    def _turn(self, ready: dict[Any, int]) -> None:
        self._wakeup.clear()
        self._say(*self.commands.take())
        is_gone = self._monitor in ready and recv_monitor_message(self._monitor)["event"] == zmq.EVENT_DISCONNECTED
        while self._socket.poll(0):
            self._heard_s = time.monotonic()
            self._take(unpacked(self._socket.recv()))
        if is_gone and self._ended is None:
            self._is_gone = self.is_lost = True
            clear_abandoned(self.address.name, timeout_s=DYING_S)
            process = f"the instrument's process {self.address.process}"
            advice = "its light should be off; if it shines, switch it off by hand or with svwfs light-off"
            if self.status is not None and self.status.bench.has_manual_light:
                advice = "switch the light off by hand"
            self._ended = RunError(f"{process} {self._how_it_ended()}: {advice}")
        if self.frames.error is not None and self._ended is None:
            self._ended = RunError(f"frames of the instrument cannot be shown: {self.frames.error}")
        now_s = time.monotonic()
        if not self._has_state.is_set() and now_s > self._heard_s + ANSWER_S:
            raise RunError(
                f"the instrument of process {self.address.process} does not answer: stop it, and start it again"
            )
        if now_s > self._hello_due_s:
            self._say_hello()
        self.commands.give_up_lost(self._heard_s)

    def _how_it_ended(self) -> str:
        return "has ended"

    def _take(self, message: object) -> None:
        if isinstance(message, NewStatus):
            self.bench, self.status = message.bench, message.status
        elif isinstance(message, Answer):
            self.frames.outdate(message.count)
            self.commands.note_answer(message)
        elif isinstance(message, State):
            self.counts, self.recording, self.kept = message.counts, message.recording, message.kept
            self._activity, self.clients, self.controller = message.activity, message.clients, message.controller
            self._is_gone = not message.is_alive
            self.frames.ring_name, self.frames.count = message.ring_name, max(message.count, self.frames.count)
            if self._is_gone and self._ended is None:
                self._ended = message.ended_by or RunError("the instrument was shut down")
            self._has_state.set()


RunningInstrument: TypeAlias = Acquisition | Connection  # as window, commands and scripts see it

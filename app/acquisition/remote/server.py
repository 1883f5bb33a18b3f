"""The instrument's end: serves any number of clients, and waits for none of them.

Frames go into a shared ring, everything else through one ZeroMQ socket, whose messages keep their order. One client has
control; the others watch. A client that falls silent loses it; the measurement continues.
"""

import inspect
import math
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, get_origin, get_type_hints

import zmq

from app.acquisition.address import Address, bound_log, file_of
from app.acquisition.command_queue import done
from app.acquisition.devices import OpenDevices
from app.acquisition.instrument import Commands, Status
from app.acquisition.remote.messages import Answer, Bye, Command, Hello, NewStatus, State, portable_error, watching
from app.acquisition.serialization import MOST_BYTES, encoded, unpacked
from app.acquisition.streams.publisher import Publisher
from app.acquisition.wakeup_pipe import WakeupPipe
from app.acquisition.worker import Acquisition
from app.bench.config import Bench
from app.bench.settings_schema import fits
from app.errors import RunError
from app.progress import run_in_thread
from drivers.errors import BadValue, WrongState

_STATE_S = 0.2  # between two states, and two looks at the size of the log
_SILENT_S = 5.0  # after which a client counts as gone
_STOPPED_S = 0.6  # between two turns, after which this process counts as stopped in between
_GATHERING_S = 0.1  # in which all that was sent to a stopped process arrives
_LINGER_MS = 300

_FOR_ALL = {"take_control", "switch_light_off", "free_minutes", "stage_times", "part"}
_NEVER_TOO_LATE = {"switch_light_off", "shut_down"}  # they make the instrument safe


@dataclass(slots=True)
class _Client:
    name: str
    pause_s: float
    heard_s: float


class Server:
    """An acquisition with its clients; `run` serves them in the calling thread."""

    def __init__(self, bench: Bench, address: Address, open_devices: OpenDevices | None = None) -> None:
        """Open the socket of the address; `RunError` if that fails."""
        self._wakeup = WakeupPipe()
        self._frames = Publisher(bench, file_of(address.name, "ring"), self._hurry)
        self.acquisition = Acquisition(bench, open_devices, publisher=self._frames)
        self._clients: dict[bytes, _Client] = {}
        self._controller = b""
        self._done: deque[tuple[bytes, Command, Future[Any]]] = deque()
        self._status: Status | None = None  # as sent
        self._state_due_s = -math.inf
        self._heard_s = math.inf  # when messages were heard last
        self._is_over = False
        self._fault: Exception | None = None  # of this end
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.SNDHWM, 0)  # no answer is dropped; news end with a silent client
        self._socket.setsockopt(zmq.MAXMSGSIZE, MOST_BYTES)  # nobody fills the memory
        self._socket.setsockopt(zmq.LINGER, _LINGER_MS)
        try:
            self._socket.bind(address.endpoint)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise RunError(f"clients cannot be served at {address.endpoint}: {error}") from error
        self._key = address.key.encode()
        self.address = replace(address, endpoint=self._socket.getsockopt_string(zmq.LAST_ENDPOINT))

    def run(self, begin: Callable[[Acquisition], object]) -> None:
        """Start the acquisition, send its first commands by `begin`, and serve; raise what ended it unasked."""
        poller = zmq.Poller()
        for each in (self._socket, self._wakeup):
            poller.register(each, zmq.POLLIN)
        end_clients = partial(self._tell_state, is_over=True)
        with ExitStack() as at_end:  # each step runs, whatever becomes of the others
            for step in (self._wakeup.close, self._context.destroy, end_clients, self._turn):
                at_end.callback(step)
            at_end.callback(self.acquisition.close)
            at_end.callback(end_clients)  # the light is off or going off: clients need not wait for the rest
            at_end.callback(self.acquisition.begin_close)
            try:
                self.acquisition.start()
                begin(self.acquisition)
                self.address.announce()
                while self.acquisition.is_alive and not self._is_over:
                    poller.poll(round(1e3 * _STATE_S))
                    self._wakeup.clear()
                    self._turn()
            except Exception as error:
                self._fault = error
                raise
        if self.acquisition.error is not None:
            raise self.acquisition.error

    def end(self) -> None:
        """Let `run` end, from any thread."""
        self._is_over = True
        self._wakeup.notify()

    def _turn(self) -> None:
        now_s = time.monotonic()
        with self.acquisition.commands.lock:  # until all are heard: one of them may switch the light off
            if now_s > self._heard_s + _STOPPED_S:
                time.sleep(_GATHERING_S)
            for identity, message in self._arrived():
                self._hear(identity, message, now_s)
        self._heard_s = time.monotonic()
        for identity in [each for each, client in self._clients.items() if now_s > client.heard_s + _SILENT_S]:
            self._forget(identity)
        while self._done:
            self._answer(*self._done.popleft())
        if now_s > self._state_due_s:
            self._tell_state()

    def _arrived(self) -> Iterator[tuple[bytes, Any]]:
        """Yield the messages that have arrived, with their senders."""
        while self._socket.poll(0):
            identity, key, body = (*self._socket.recv_multipart(), b"", b"")[:3]
            with suppress(RunError):  # of another version
                yield identity, unpacked(body) if key == self._key else None

    def _hear(self, identity: bytes, message: Any, now_s: float) -> None:
        client = self._clients.get(identity)
        if client is not None:
            client.heard_s = now_s
        if isinstance(message, Command):
            self._execute(identity, message)
        elif isinstance(message, Hello) and client is None and fits(message, Hello) and message.pause_s >= 0:
            self._clients[identity] = _Client(message.name, message.pause_s, now_s)
            self._ask_for_frames()
            if message.takes_control and not self._controller:
                self._controller = identity
            self._tell(identity, self._new_status(), self._present())
        elif isinstance(message, Bye) and client is not None:
            self._forget(identity)

    def _forget(self, identity: bytes) -> None:
        del self._clients[identity]
        self._ask_for_frames()
        if self._controller == identity:
            self._controller = b""

    def _ask_for_frames(self) -> None:
        self._frames.read_every(min((client.pause_s for client in self._clients.values()), default=math.inf))

    def _execute(self, identity: bytes, command: Command) -> None:
        """Begin a command; its future is answered when it is done."""
        try:
            future = self._begin(identity, command)
        except Exception as error:  # noqa: BLE001 - the client is informed
            future = Future()
            future.set_exception(error)

        def note(answer: Future[Any]) -> None:
            self._done.append((identity, command, answer))
            self._wakeup.notify()

        future.add_done_callback(note)

    def _begin(self, identity: bytes, command: Command) -> Future[Any]:
        name = command.request
        if time.monotonic() > command.until_s and name not in _NEVER_TOO_LATE:
            raise WrongState("this command came too late and was not executed: send it again")
        if identity not in self._clients and name != "switch_light_off":
            raise WrongState("the instrument did not hear from this program for too long: send the command again")
        if identity != self._controller and name not in _FOR_ALL:
            holder = self._clients.get(self._controller)
            raise WrongState(watching("" if holder is None else holder.name))
        if name == "part":
            return run_in_thread(partial(self._frames.part, *command.arguments), "part of a frame")[0]
        if name == "take_control":
            self._controller = identity
            return done()
        if name == "shut_down":
            self._is_over = True  # after this turn, in which it is answered
            return done()
        return _begin_request(command, self.acquisition)

    def _answer(self, identity: bytes, command: Command, future: Future[Any]) -> None:
        failure, count = future.exception(), 0
        result, error = (future.result(), None) if failure is None else (None, portable_error(failure))
        if error is not None and not isinstance(failure, type(error)):  # unexpected: the log shows where
            traceback.print_exception(failure)
        if command.request != "part":
            count = self._frames.count
            self._tell_state()
        try:
            self._tell(identity, Answer(command.number, result, error, count))
        except RunError as unsendable:
            self._tell(identity, Answer(command.number, None, unsendable, count))

    def _present(self, *, is_over: bool = False) -> State:
        acquisition = self.acquisition
        fault = acquisition.error or self._fault
        controller = self._clients.get(self._controller)
        return State(
            activity=acquisition.activity,
            counts=acquisition.counts,
            recording=acquisition.recording,
            kept=acquisition.kept,
            ended_by=None if fault is None else portable_error(fault),
            is_alive=not is_over,
            clients=tuple(client.name for client in self._clients.values()),
            controller="" if controller is None else controller.name,
            ring_name=self._frames.ring_name,
            count=self._frames.count,
        )

    def _tell_state(self, *, is_over: bool = False) -> None:
        """Send the state to all clients, behind the status if there is another.

        The status is read after the activity and sent before it: as soon as a routine ends, it is that after it.
        """
        self._state_due_s = time.monotonic() + _STATE_S
        state = self._present(is_over=is_over)
        if (new_status := self._new_status()).status is not self._status:
            self._status = new_status.status
            self._tell_all(new_status)
        self._tell_all(state)
        bound_log(self.address.name)

    def _hurry(self) -> None:
        """Let clients know of another ring at once."""
        self._state_due_s = -math.inf
        self._wakeup.notify()

    def _new_status(self) -> NewStatus:
        return NewStatus(self.acquisition.bench, self.acquisition.status)

    def _tell_all(self, message: State | NewStatus) -> None:
        packed = encoded(message)
        for identity in self._clients:
            self._socket.send_multipart([identity, packed])

    def _tell(self, identity: bytes, *messages: object) -> None:
        for message in messages:
            self._socket.send_multipart([identity, encoded(message)])


def _begin_request(command: Command, acquisition: Acquisition) -> Future[Any]:
    """Call the method that a command names, return its future; `BadValue` if there is none, or arguments do not fit."""
    name = command.request
    method: Any = getattr(Acquisition, name, None)
    hints = get_type_hints(method) if inspect.isfunction(method) and not name.startswith("_") else {}
    if name not in vars(Commands) and get_origin(hints.get("return")) is not Future:
        raise BadValue(f"the instrument knows no command {name}")
    try:
        bound = inspect.signature(method).bind(acquisition, *command.arguments, **command.named)
    except TypeError as error:
        raise BadValue(f"{name}: {error}") from error
    for key in bound.arguments.keys() & hints:
        if not fits(value := bound.arguments[key], hints[key]):
            kind = getattr(hints[key], "__name__", hints[key])
            raise BadValue(f"{name}: {key} must be {kind}, not {value!r:.60}")
    future: Future[Any] = method(*bound.args, **bound.kwargs)
    return future

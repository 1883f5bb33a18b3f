"""A child process at low priority for long computations.

There they take no turns at Python's lock with live frames. It ends as soon as its standard input closes, however its
parent ends. Messages are pickled, their arrays next to the rest: so they are not copied under Python's lock.
"""

import os
import pickle
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import IO, Any, NamedTuple, TypeAlias, cast

from reconstruction.runtime.child_process import start_child, take_pipes

NICENESS = 10  # of what must not delay frames
_ROOT = str(Path(__file__).resolve().parents[2])


Work: TypeAlias = Callable[[Iterator[Any], Callable[[object], None]], None]
"""A function of a module, `work(messages, answer)`."""


class Pickled(NamedTuple):
    """A pickled message."""

    rest: bytes
    arrays: list[memoryview]


def pickled(message: object) -> Pickled:
    """Pickle a message, whose arrays must not change until it is sent."""
    buffers = list[pickle.PickleBuffer]()
    rest = pickle.dumps(message, pickle.HIGHEST_PROTOCOL, buffer_callback=buffers.append)
    return Pickled(rest, [buffer.raw() for buffer in buffers])


class BackgroundProcess:
    """Runs `work` in a process of its own."""

    def __init__(self, work: Work) -> None:
        """The standard output of `work` goes to the standard error."""
        given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
        search_path = os.pathsep.join([_ROOT, *filter(None, given)])  # an empty part is the working directory
        self.process = start_child(
            f"from {__name__} import _run; _run({work.__module__!r}, {work.__name__!r})",
            environment={"PYTHONPATH": search_path, "OPENBLAS_NUM_THREADS": "1"},
            is_background=True,
        )
        self._messages, self._answers = cast("IO[bytes]", self.process.stdin), cast("IO[bytes]", self.process.stdout)

    def send(self, message: object) -> None:
        """Send a message, which may be pickled already; `OSError` if the process has ended."""
        rest, arrays = message if isinstance(message, Pickled) else pickled(message)
        pickle.dump((rest, [array.nbytes for array in arrays]), self._messages, pickle.HIGHEST_PROTOCOL)
        for array in arrays:
            self._messages.write(array)
        self._messages.flush()

    def receive(self) -> Any:
        """Wait for an answer; `EOFError` if the process has ended."""
        try:
            return pickle.load(self._answers)  # noqa: S301 - our own child wrote it
        except pickle.UnpicklingError as error:  # it ended amid the answer
            raise EOFError from error

    def kill(self) -> None:
        """End the process at once; a thread that waits for an answer is woken."""
        self.process.kill()
        self.process.wait()

    def close(self) -> None:
        """Kill the process and close the pipes, which no thread may use any more."""
        self.kill()
        self._answers.close()
        with suppress(OSError):  # what it had not read is lost
            self._messages.close()


def _run(module: str, name: str) -> None:
    """Entry point of the child process: lower the priority, do the work, and end."""
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    messages, answers = take_pipes()
    arrived = SimpleQueue[Any]()

    def read() -> None:
        while True:
            try:
                rest, sizes = pickle.load(messages)  # noqa: S301 - our own parent wrote it
                arrays = [bytearray(size) for size in sizes]
                if any(messages.readinto(array) < len(array) for array in arrays):
                    os._exit(0)
                arrived.put(pickle.loads(rest, buffers=arrays))  # noqa: S301 - our own parent wrote it
            except (EOFError, pickle.UnpicklingError):  # closed, perhaps amid a message
                os._exit(0)
            except Exception:  # noqa: BLE001 - the parent would wait for an answer
                traceback.print_exc()
                os._exit(1)

    def answer(result: object) -> None:
        pickle.dump(result, answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()

    Thread(target=read, daemon=True).start()
    getattr(import_module(module), name)((arrived.get() for _ in count()), answer)
    os._exit(0)

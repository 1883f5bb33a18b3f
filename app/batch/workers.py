"""Workers of Dask: processes of this computer, or those of a running scheduler."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

from app.errors import InputError, RunError
from app.files import in_words

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

T = TypeVar("T")
R = TypeVar("R")

_CONNECT_S = 20
_SCHEMES = {"tcp", "tls", "ws", "wss", "ucx"}  # of Dask's addresses
_LEAST_WAITING = 16  # tasks at the scheduler; more would only delay Ctrl-C
_CLOSE_S = 30
_ENVIRONMENT = "distributed.nanny.pre-spawn-environ"
_CONFIGURATION: dict[str, Any] = {
    f"{_ENVIRONMENT}.MALLOC_TRIM_THRESHOLD_": None,  # Dask's maps every array of a frame anew: half the speed
    f"{_ENVIRONMENT}.MALLOC_ARENA_MAX": 1,  # an arena for each thread takes a hundred megabytes more
    # Dask drops a worker that restarts too slowly.
    "distributed.deploy.lost-worker-timeout": "365 days",
    "distributed.scheduler.http.routes": [],  # no pages, which every user of this computer could read
    "distributed.worker.http.routes": [],
}


class Workers:
    """Evaluates tasks on the workers of a scheduler; see `app.progress.Evaluate`."""

    def __init__(self, client: Client) -> None:
        self._client = client

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Exception]]:
        """Yield each item with its result or error as they finish; `RunError` if the scheduler is lost before."""
        from distributed import as_completed

        remaining = iter(items)
        waiting: dict[Future[R], T] = {}
        finished = as_completed(loop=self._client.loop)
        try:
            while True:
                wanted = max(_LEAST_WAITING, 2 * self._threads()) - len(waiting)
                for item in islice(remaining, max(wanted, 0)):
                    future = self._client.submit(function, item, pure=False)
                    waiting[future] = item
                    finished.add(future)
                if not waiting:
                    return
                future = next(finished)
                yield waiting.pop(future), _outcome(future)
        finally:
            self._client.cancel(list(waiting))

    def _threads(self) -> int:
        try:
            return sum(self._client.nthreads().values())
        except (OSError, TimeoutError, RuntimeError) as error:  # RuntimeError: the client has closed
            raise RunError(f"the scheduler is lost: {in_words(error)}") from error


def _outcome(future: Any) -> Any:
    from distributed.client import FutureCancelledError
    from distributed.scheduler import KilledWorker

    try:
        return future.result()
    except FutureCancelledError as error:
        return RunError(f"the scheduler is lost: {error.reason}")
    except KilledWorker as error:
        return InputError(f"{error.allowed_failures + 1} workers died of it; is there too little memory?")
    except Exception as error:  # noqa: BLE001 - the caller decides
        return error


@contextmanager
def workers(count: int | None, scheduler: str | None) -> Iterator[Workers]:
    """Start `count` workers, by default one for each core, or connect to the scheduler at an address.

    Processes started here accept only connections with a certificate of this run (TLS). `InputError` if Dask is not
    installed, or both are given, `RunError` if there is no scheduler at the address.
    """
    if count is not None and scheduler is not None:
        raise InputError("--workers starts processes here, --scheduler uses the workers of a cluster: give one option")
    if scheduler is not None:
        _check_address(scheduler)  # a client that finds the fault takes 40 s to close
    os.environ["PYTHONSAFEPATH"] = "1"  # for workers and Python's own helper processes, as in `app.cli.main`
    try:
        import dask
        from distributed import Client, LocalCluster, Security

        security = Security.temporary() if scheduler is None else None
    except ImportError as error:
        raise InputError("workers need Dask: install the extra svwfs[batch]") from error
    with ExitStack() as stack:
        if scheduler is None:
            stack.enter_context(dask.config.set(_CONFIGURATION))
            cluster = LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                security=security,
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
                preload="app.batch.run",
            )
            stack.callback(_close, cluster)
        try:
            client = Client(cluster if scheduler is None else scheduler, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise RunError(f"{scheduler}: no scheduler can be reached there: {in_words(error)}") from error
        stack.callback(_close, client)
        yield Workers(client)


def _check_address(scheduler: str) -> None:
    """Raise `InputError` unless an address has a host and a port."""
    try:
        parts = urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}")
        is_complete = parts.scheme in _SCHEMES and bool(parts.hostname and parts.port)  # ValueError: out of range
    except ValueError:
        is_complete = False
    if not is_complete:
        raise InputError(f"--scheduler {scheduler}: give host and port, as tcp://node1:8786")


def _close(opened: Client | LocalCluster) -> None:
    """Close; what a busy computer does not end in time ends with this process."""
    with suppress(TimeoutError):
        opened.close(timeout=_CLOSE_S)

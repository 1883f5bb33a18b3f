"""Preparation of a worker process by Dask, which calls `dask_setup`."""

import signal

import app.batch.work  # noqa: F401 - while the process starts, rather than with the first block


def dask_setup(_worker: object) -> None:
    """Ignore Ctrl-C, which a terminal sends to all processes; the command stops its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

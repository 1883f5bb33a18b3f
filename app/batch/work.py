"""Work on one block of one recording: it is read, reconstructed and written."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import xarray as xr

from app.batch.job import Job, Source
from app.batch.store import ResultStore
from app.bench.config import write_bench
from app.errors import InputError, RunError
from app.measurement.measurement import Measurement
from app.recording.reader import Recording
from app.recording.reprocess import BLOCK_FRAMES, Reprocessing
from app.results.dataset import results_in_pieces
from app.run_facts import software_facts


@dataclass(frozen=True, slots=True)
class Block:
    """A block of frames of a recording."""

    source: Source
    number: int  # of the recording in the store
    frames: range


@dataclass(frozen=True, slots=True)
class DoneBlock:
    """Facts about a block whose results are in the store."""

    problem: str  # of the first frame without a wavefront
    damaged: tuple[str, ...]  # a sentence for each frame that cannot be read
    facts: dict[str, Any]  # bench in force, software and computer


def reconstruct_block(store: Path, job: Job, block: Block) -> DoneBlock:
    """Reconstruct a block and write its results into the store."""
    _check_software(job)
    problem, bench = "", ""
    damaged: dict[int, str] = {}

    def noted() -> Iterator[tuple[Measurement, dict[str, Any]]]:
        nonlocal problem, bench
        for made in _prepared(block.source, job)(block.frames, damaged.__setitem__):
            problem = problem or made.problem
            if made.calibration is not None and not bench:
                bench = write_bench(made.calibration.bench)
            yield made, {}

    ResultStore(store).write(block.number, block.frames, results_in_pieces(noted()), damaged)
    reasons = tuple(damaged.values())
    return DoneBlock(problem or "".join(reasons[:1]), reasons, {"bench": bench, **software_facts()})


def first_result(job: Job, source: Source) -> xr.Dataset | None:
    """Return the first result of a recording as a piece of one frame; None if its first block has no wavefront."""
    _check_software(job)
    made = _prepared(source, job)(source.chosen[:BLOCK_FRAMES], lambda *_: None)
    first = next((each for each in made if each.wavefront is not None), None)
    return None if first is None else next(results_in_pieces([(first, {})]))


def _check_software(job: Job) -> None:
    if not job.is_of_this_software:
        raise RunError(f"a worker runs another version than {job.software}: install the same everywhere")


@lru_cache(maxsize=1)  # blocks come in the order of the recordings; a reconstructor takes tens of megabytes
def _prepared(source: Source, job: Job) -> Reprocessing:
    recording = Recording(source.folder)
    if len(recording) < source.chosen.stop:
        raise InputError(
            f"{source.folder}: {source.frames - len(recording)} of {source.frames} frames have no line; svwfs recover"
            " lists them"
        )
    return Reprocessing(recording, job.change, rounds=job.rounds)


def dask_setup(_worker: object) -> None:
    """Ignore Ctrl-C, which a terminal sends to all processes: Dask calls this as a worker process starts.

    The command stops its workers. They load this module while they start, rather than with the first block.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)

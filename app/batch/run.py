"""`svwfs batch`: reconstruct the missing blocks of recordings into one store."""

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import repeat
from pathlib import Path
from typing import Any

import xarray as xr

from app.batch.store import BatchInput, BatchJob, ResultStore, is_store, store_attributes
from app.bench.config import write_bench
from app.errors import InputError, Interrupted, RunError
from app.files import check_writable, in_words, make_folder, remove_partial
from app.measurement.measurement import Measurement
from app.progress import Evaluate, Progress
from app.recording.folder import lock
from app.recording.reader import Recording
from app.recording.reprocess import BLOCK_FRAMES, Reprocessing
from app.results.dataset import results_in_pieces
from app.results.replay import changed_bench, first_bench
from app.results.result_file import with_mode_names
from app.run_facts import software_facts


@dataclass(slots=True)
class Batch:
    """Outcome of a run."""

    recordings: int = 0  # that were named, each once
    frames: int = 0  # of the recordings that are done
    wavefronts: int = 0
    computed: int = 0  # frames of this run; the others were there
    problem: str = ""  # of the first frame without a wavefront in this run
    damaged: dict[Path, list[str]] = field(default_factory=dict)  # recordings with a sentence for each lost frame
    failed: dict[Path, str] = field(default_factory=dict)  # recordings with the reason
    copies: dict[Path, Path] = field(default_factory=dict)  # identical recordings with the one that was reconstructed


@dataclass(frozen=True, slots=True)
class _Block:
    source: BatchInput
    number: int  # of the recording in the store
    frames: range


@dataclass(frozen=True, slots=True)
class _DoneBlock:
    """Facts about a block whose results are in the store."""

    problem: str  # of the first frame without a wavefront
    damaged: tuple[str, ...]  # a sentence for each frame that cannot be read
    facts: dict[str, Any]  # bench in force, software and computer


def check_batch(folders: Sequence[Path], out: Path, job: BatchJob) -> tuple[list[BatchInput], Batch]:
    """Check what a batch reads; return the complete recordings, and the others in a `Batch`.

    `InputError` if no recording can be used, `out` cannot be the store of this job, or its settings fit no recording.
    """
    for folder in folders:
        if out.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{out}: lies in the recording {folder}: give the results another place")
    _check_free(out)
    if is_store(out):
        ResultStore(out).check(job)
    found, batch = dict[str, BatchInput](), Batch()
    for folder in folders:
        try:
            source = BatchInput.of(folder, job.frames)
        except InputError as error:
            batch.failed[folder] = str(error)
            continue
        first = found.setdefault(source.fingerprint, source)
        if first.folder != source.folder:
            batch.copies[folder] = first.folder
    sources, batch.recordings = list(found.values()), len(found) + len(batch.failed)
    if not sources:
        raise InputError("; ".join(dict.fromkeys(batch.failed.values())))
    if job.settings:
        _check_settings(sources, job.settings)
    return sources, batch


def _check_settings(sources: Sequence[BatchInput], settings: tuple[str, ...]) -> None:
    """Raise `InputError` if the settings are possible in the bench of no recording."""
    for source in sources:
        with suppress(InputError):
            changed_bench(Recording(source.folder).bench, settings)
            return
    changed_bench(Recording(sources[0].folder).bench, settings)


def run_batch(folders: Sequence[Path], out: Path, job: BatchJob, evaluate: Evaluate, progress: Progress) -> Batch:
    """Reconstruct the missing blocks of recordings into the store `out`, which is made if necessary.

    `evaluate` calls a function with each block, here or on workers that see the same folders. `InputError` if no
    recording can be used, or the store is of another job; `RunError` if nothing can be written, or the workers are
    lost; `Interrupted` on Ctrl-C. What was finished stays, and the text says how much that is.
    """
    sources, batch = check_batch(folders, out, job)
    with _only_writer(out):
        store = _opened(out, job, sources, evaluate, progress)
        numbered, changed = store.register(sources)
        batch.failed |= changed
        filling = _Filling(store, numbered, batch)

        def state() -> str:
            return f"{filling.done} of {filling.frames} frames"

        progress(state(), filling.done / filling.frames)
        try:
            for block, result in evaluate(partial(reconstruct_block, out, job), filling.blocks()):
                if isinstance(result, RunError):  # the disk or the workers, not this recording
                    raise result
                filling.take(block, result)
                progress(state(), filling.done / filling.frames)
        except RunError as error:
            raise RunError(f"{error}; {state()} are in {out}, the same command does the rest") from error
        except Interrupted:
            raise Interrupted(f"interrupted: {state()} are in {out}, the same command does the rest") from None
        remove_partial(out)  # of workers that were killed
        for number, source in numbered:
            if source.folder not in batch.failed:
                batch.frames += len(source.chosen)
                batch.wavefronts += store.count(number, source)
    return batch


def _opened(
    out: Path, job: BatchJob, sources: Sequence[BatchInput], evaluate: Evaluate, progress: Progress
) -> ResultStore:
    """Open the store, or make it for results like those of the first recording that has any."""
    if is_store(out):
        return ResultStore(out)
    problem = ""
    for source in sources:
        progress("preparing", 0.0)
        # Every worker prepares itself, which it needs anyway; the first answer is enough.
        _, template = next(evaluate(partial(first_result, job), repeat(source)))
        if isinstance(template, RunError):
            raise template
        if isinstance(template, Exception):
            problem = problem or _reason(template)
        elif template is not None:
            return ResultStore.create(out, job, template)
    raise RunError(f"{out}: there is nothing to write: {problem or 'no frame has a wavefront'}")


class _Filling:
    """The blocks of a run: which are missing, and what becomes of each."""

    def __init__(self, store: ResultStore, numbered: Sequence[tuple[int, BatchInput]], batch: Batch) -> None:
        self._store, self._numbered, self._batch = store, numbered, batch
        self._missing = {number: store.missing(number, source) for number, source in numbered}
        self.frames = sum(len(source.chosen) for _, source in numbered)
        self.done = self.frames - sum(len(frames) for blocks in self._missing.values() for frames in blocks)

    def blocks(self) -> Iterator[_Block]:
        """Yield the missing blocks, recording by recording; the rest of a failed one is left out."""
        for number, source in self._numbered:
            for frames in tuple(self._missing[number]):
                if source.folder in self._batch.failed:
                    break
                yield _Block(source, number, frames)

    def take(self, block: _Block, result: _DoneBlock | Exception) -> None:
        """Count a block, and write the provenance of a recording that is done or has failed."""
        number, source, failed = block.number, block.source, self._batch.failed
        if isinstance(result, _DoneBlock):
            self.done += len(block.frames)
            self._batch.computed += len(block.frames)
            self._batch.problem = self._batch.problem or result.problem
            if result.damaged:
                self._batch.damaged.setdefault(source.folder, []).extend(result.damaged)
            self._missing[number].remove(block.frames)
        else:
            failed.setdefault(source.folder, _reason(result))
        if source.folder in failed:
            self._store.write_provenance(number, source, {"failed": failed[source.folder]})
        elif isinstance(result, _DoneBlock) and not self._missing[number]:
            self._store.write_provenance(number, source, result.facts)


def _reason(error: Exception) -> str:
    return in_words(error) if isinstance(error, InputError) else f"{type(error).__name__}: {in_words(error)}"


@contextmanager
def _only_writer(folder: Path) -> Iterator[None]:
    """Keep other runs out of the folder of a store; `InputError` if one writes into it already."""
    make_folder(folder.parent)
    own = folder.with_name(f".{folder.name}.lock")
    with own.open("ab") as file:
        try:
            lock(file)
        except InputError as error:
            raise InputError(f"{folder}: another svwfs batch is writing into it") from error
        try:
            yield
        finally:
            with suppress(OSError):  # Windows removes no open file
                own.unlink()


def _check_free(folder: Path) -> None:
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; the results need a folder")
        if folder.is_dir() and not store_attributes(folder) and any(folder.iterdir()):
            raise InputError(f"{folder}: exists already and holds no results of svwfs batch")
        if folder.suffix.lower() not in {"", ".zarr"} and not is_store(folder):
            raise InputError(f"{folder}: the results are a Zarr store, which is a folder: end its name with .zarr")
        check_writable(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be used: {in_words(error)}") from error


def reconstruct_block(store: Path, job: BatchJob, block: _Block) -> _DoneBlock:
    """Reconstruct a block and write its results into the store."""
    job.check_software()
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
    return _DoneBlock(problem or "".join(reasons[:1]), reasons, {"bench": bench, **software_facts()})


def first_result(job: BatchJob, source: BatchInput) -> xr.Dataset | None:
    """Return the first result of a recording, one frame; None if its first block has no wavefront."""
    job.check_software()
    made = _prepared(source, job)(source.chosen[:BLOCK_FRAMES], lambda *_: None)
    first = next((each for each in made if each.wavefront is not None), None)
    if first is None:
        return None
    bench = first_bench(Recording(source.folder), source.chosen, job.change)
    return with_mode_names(next(results_in_pieces([(first, {})])), bench)


@lru_cache(maxsize=1)  # blocks come in the order of the recordings; a reconstructor takes tens of megabytes
def _prepared(source: BatchInput, job: BatchJob) -> Reprocessing:
    recording = Recording(source.folder)
    if len(recording) < source.chosen.stop:
        raise InputError(recording.lost_lines)
    return Reprocessing(recording, job.change, rounds=job.rounds)


def dask_setup(_worker: object) -> None:
    """Ignore Ctrl-C, sent to all processes: the command stops its workers. Dask calls this as a worker starts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

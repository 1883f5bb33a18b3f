"""`svwfs batch`: reconstruct recordings into one store; what is there already is not done again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any

from app.batch.job import Job, Source, find_sources
from app.batch.store import ResultStore, is_store, store_attributes
from app.batch.work import Block, DoneBlock, first_result, reconstruct_block
from app.errors import InputError, Interrupted, RunError
from app.files import check_writable, in_words, make_folder, remove_partial
from app.progress import Progress
from app.recording.folder import lock
from app.tasks import Evaluate


@dataclass(slots=True)
class Batch:
    """Outcome of a run."""

    recordings: int  # that were named, each once
    frames: int = 0  # of the recordings that are done
    wavefronts: int = 0
    computed: int = 0  # frames of this run; the others were there
    problem: str = ""  # of the first frame without a wavefront in this run
    damaged: dict[Path, list[str]] = field(default_factory=dict)  # recordings with a sentence for each lost frame
    failed: dict[Path, str] = field(default_factory=dict)  # recordings with the reason
    copies: dict[Path, Path] = field(default_factory=dict)  # identical recordings with the one that was reconstructed


def check_store(folders: Sequence[Path], out: Path, job: Job) -> None:
    """Raise `InputError` if `out` cannot be the store of this job; no worker is needed to tell."""
    for folder in folders:
        if out.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{out}: lies in the recording {folder}: give the results another place")
    check_free(out)
    if is_store(out):
        ResultStore(out).check(job)


def run_batch(folders: Sequence[Path], out: Path, job: Job, evaluate: Evaluate, progress: Progress) -> Batch:
    """Reconstruct the blocks of recordings that are missing in the store `out`, which is made if necessary.

    `evaluate` calls a function with each block, here or on workers that see the same folders. `InputError` if no
    recording can be used, or the store is of another job; `RunError` if nothing can be written, or the workers are
    lost; `Interrupted` on Ctrl-C. What was finished stays, and the text says how much that is.
    """
    check_store(folders, out, job)
    sources, failed, copies = find_sources(folders, job.frames)
    batch = Batch(len(sources) + len(failed), failed=failed, copies=copies)
    if not sources:
        raise InputError("; ".join(dict.fromkeys(failed.values())))
    with only_writer(out):
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
        filling.count()
    return batch


def _opened(out: Path, job: Job, sources: Sequence[Source], evaluate: Evaluate, progress: Progress) -> ResultStore:
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

    def __init__(self, store: ResultStore, numbered: Sequence[tuple[int, Source]], batch: Batch) -> None:
        self._store, self._numbered, self._batch = store, numbered, batch
        self._missing: dict[int, int] = {}  # blocks
        self._facts: dict[int, dict[str, Any]] = {}
        self.frames = self.done = sum(len(source.chosen) for _, source in numbered)
        for number, source in numbered:
            missing = store.missing(number, source)
            self._missing[number] = len(missing)
            self.done -= sum(map(len, missing))

    def blocks(self) -> Iterator[Block]:
        """Yield the missing blocks, recording by recording; the rest of a failed one is left out."""
        for number, source in self._numbered:
            for frames in self._store.missing(number, source):
                if source.folder in self._batch.failed:
                    break
                yield Block(source, number, frames)

    def take(self, block: Block, result: DoneBlock | Exception) -> None:
        """Count a block, and write the provenance of a recording that is done or has failed."""
        number, source, failed = block.number, block.source, self._batch.failed
        if isinstance(result, DoneBlock):
            self.done += len(block.frames)
            self._batch.computed += len(block.frames)
            self._batch.problem = self._batch.problem or result.problem
            if result.damaged:
                self._batch.damaged.setdefault(source.folder, []).extend(result.damaged)
            self._missing[number] -= 1
            self._facts[number] = result.facts
        else:
            failed.setdefault(source.folder, _reason(result))
        if source.folder in failed:
            self._store.write_provenance(number, source, {"failed": failed[source.folder]})
        elif not self._missing[number]:
            self._store.write_provenance(number, source, self._facts.pop(number))

    def count(self) -> None:
        """Count frames and wavefronts of the recordings that are done."""
        for number, source in self._numbered:
            if source.folder not in self._batch.failed:
                self._batch.frames += len(source.chosen)
                self._batch.wavefronts += self._store.count(number, source)


def _reason(error: Exception) -> str:
    """Say why a recording cannot be reconstructed; an unexpected error with its kind."""
    return in_words(error) if isinstance(error, InputError) else f"{type(error).__name__}: {in_words(error)}"


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Check the folder of a store, and keep other runs out; `InputError` if one writes into it already."""
    check_free(folder)
    make_folder(folder.parent)
    with folder.with_name(f".{folder.name}.lock").open("ab") as file:
        try:
            lock(file)
        except InputError as error:
            raise InputError(f"{folder}: another svwfs batch is writing into it") from error
        yield


def check_free(folder: Path) -> None:
    """Raise `InputError` if a folder cannot hold a store."""
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; the results need a folder")
        if folder.is_dir() and not store_attributes(folder) and any(folder.iterdir()):
            raise InputError(f"{folder}: exists already and holds no results of svwfs batch")
        check_writable(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be used: {in_words(error)}") from error

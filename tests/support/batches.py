"""Small batches: a bench of 5 x 7 lenslets, blocks of few frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
import xarray as xr

from app.batch import store
from app.batch.run import Batch, run_batch
from app.batch.store import BatchJob
from app.progress import Evaluate
from app.recording import reprocess
from app.recording.reader import Recording
from app.results.replay import change_of, replay

QUICK = ("registration.warp=affine", "reconstruction.response=false")  # a reconstructor is prepared at once

T = TypeVar("T")
R = TypeVar("R")


def small_blocks(monkeypatch: pytest.MonkeyPatch, frames: int) -> None:
    """Make blocks of a few frames."""
    monkeypatch.setattr(store, "BLOCK_FRAMES", frames)
    monkeypatch.setattr(reprocess, "BLOCK_FRAMES", frames)


def one_by_one(function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Exception]]:
    """Call a function with each item in this process; see `Evaluate`."""
    for item in items:
        try:
            yield item, function(item)
        except Exception as error:  # noqa: BLE001 - the caller decides
            yield item, error


def batch(
    out: Path, *recordings: Recording | Path, job: BatchJob | None = None, evaluate: Evaluate = one_by_one
) -> Batch:
    """Run a batch, by default in this process."""
    folders = [each.folder if isinstance(each, Recording) else each for each in recordings]
    return run_batch(folders, out, job or BatchJob(), evaluate, lambda *_: None)


class Counting:
    """Evaluates in this process, and counts the items; `after` is called with the number of results."""

    def __init__(self, after: Callable[[int], None] = lambda _: None) -> None:
        self._after = after
        self.items = 0

    def __call__(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[tuple[T, R | Exception]]:
        for each in one_by_one(function, items):
            self.items += 1
            yield each
            self._after(self.items)


def assert_equals_replay(out: Path, recording: Recording, folder: Path, *settings: str) -> None:
    """Compare the results of a recording in a store, bit by bit, with the file that `svwfs replay --out` writes."""
    file = folder / f"{recording.folder.name}.nc"
    change = change_of(None, settings)
    replay(recording.folder, change, frames=None, out=file, must_match=False, progress=lambda *_: None)
    added = {"recording_index", "recorded_rms", "difference_rms"}
    with xr.open_dataset(file) as replayed, xr.open_zarr(out) as stored:
        mine = stored.sel(recording=recording.folder.name).isel(frame=replayed["recording_index"].to_numpy())
        names = set(map(str, replayed.variables)) - added
        assert len(names) > 30
        for name in names:
            np.testing.assert_array_equal(mine[name], replayed[name], err_msg=name)
            if replayed[name].dtype.kind in "biuf":  # texts have several types
                assert mine[name].dtype == replayed[name].dtype
            assert mine[name].attrs.get("units") == replayed[name].attrs.get("units")


def files_of(out: Path) -> dict[str, tuple[int, bytes]]:
    """Inode and contents of every chunk of results: an unchanged inode was not written again."""
    client_only = {"frame", "frames", "recording", "provenance"}
    return {
        str(path.relative_to(out)): (path.stat().st_ino, path.read_bytes())
        for path in sorted(out.rglob("c/**/*"))
        if path.is_file() and path.relative_to(out).parts[0] not in client_only
    }

"""The store of a batch: a Zarr group of results (recording, frame, ...), and the job it belongs to.

A chunk holds one block of frames of one recording, and every file is written atomically, so workers need no lock. The
chunk of `state` is written last: a block whose chunk exists is done. Recordings are identified by `run.json` alone.
"""

from __future__ import annotations

import asyncio
import hashlib
import itertools
import json
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.core.buffer import Buffer
from zarr.errors import ZarrUserWarning
from zarr.storage import LocalStore

from app.bench.config import parse_bench
from app.errors import InputError, RunError
from app.files import in_words, write_whole
from app.measurement.calibration import Calibration
from app.recording.folder import RUN, read_run, recorded_frames
from app.recording.frame_array import METADATA
from app.recording.reader import selected
from app.recording.reprocess import BLOCK_FRAMES, Change
from app.results.replay import change_of
from app.results.result_file import FRAME, about

FORMAT = "svwfs batch 1"
_SOFTWARE = f"svwfs {version('svwfs')}"
STATE = "state"
WAVEFRONT, NO_WAVEFRONT, DAMAGED = 1, 2, 3  # values of `state`; 0: not done

_RECORDING = "recording"
_PROVENANCE, _FRAMES = "provenance", "frames"
_COORDINATES = ("frame_index", "time", "bias_age", _PROVENANCE, _FRAMES)
_NAMES_CHUNK, _FRAME_CHUNK = 4096, 1 << 16


class _DurableStore(LocalStore):
    """A folder in which every file is on the disk before it has its name."""

    async def set(self, key: str, value: Buffer) -> None:
        """Write a file."""
        self._check_writable()
        await asyncio.to_thread(write_whole, self.root / key, value.to_bytes())


class ResultStore:
    """An existing store, opened to be written into; it belongs to one `BatchJob`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        try:
            self._group = zarr.open_group(_DurableStore(folder), mode="r+", zarr_format=3, use_consolidated=False)
            self._arrays = dict(self._group.arrays())
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"{folder}: cannot be read as results of svwfs batch: {in_words(error)}") from error
        self._of_frames = {
            name: array
            for name, array in self._arrays.items()
            if _dimensions(array)[:2] == (_RECORDING, FRAME) and name != STATE
        }

    @classmethod
    def create(cls, folder: Path, job: BatchJob, template: xr.Dataset) -> ResultStore:
        """Make an empty store for results like these of some frames of one recording."""
        group = zarr.open_group(_DurableStore(folder), mode="a", zarr_format=3)
        group.attrs.update({"format": FORMAT})
        words = "not_done wavefront no_wavefront damaged"
        meanings = {"flag_values": [0, WAVEFRONT, NO_WAVEFRONT, DAMAGED], "flag_meanings": words}
        state = about("1", "whether the frame has a wavefront") | meanings
        text: Any = np.dtypes.StringDType()
        template = template.drop_vars("recording_index")  # it is the position along `frame`
        for name, variable in {**template.variables, STATE: xr.Variable(FRAME, np.zeros(1, np.uint8), state)}.items():
            kind, dims, shape = variable.dtype.kind, variable.dims, variable.shape[1:]
            if dims[:1] != (FRAME,):
                values = variable.values.astype(text) if kind == "U" else variable.values
                _make(group, name, dims, variable.attrs, data=values)
                continue
            _make(
                group,
                name,
                (_RECORDING, *dims),
                variable.attrs,
                shape=(0, 0, *shape),
                chunks=(1, BLOCK_FRAMES, *shape),  # a block of frames
                dtype=variable.dtype,
                fill_value=np.nan if kind == "f" else -1 if kind == "i" else 0,
            )
        for name, dtype, along, chunk, long_name in (
            (_RECORDING, text, _RECORDING, _NAMES_CHUNK, "name of the recording"),
            (_PROVENANCE, text, _RECORDING, 1, "JSON: folder, bench, software, computer, failure"),
            (_FRAMES, np.int64, _RECORDING, _NAMES_CHUNK, "number of recorded frames"),
            (FRAME, np.int64, FRAME, _FRAME_CHUNK, "the frame's index in the recording"),
        ):
            _make(group, name, (along,), {"long_name": long_name}, shape=(0,), chunks=(chunk,), dtype=dtype)
        more = [str(name) for name in template.coords if name not in template.dims]
        coordinates = " ".join(dict.fromkeys((*more, *_COORDINATES)))
        # the job is written last: a store without it is not whole
        group.attrs.update({"title": "Space-variant wavefronts", "coordinates": coordinates, "job": asdict(job)})
        return cls(folder)

    def check(self, job: BatchJob) -> None:
        """Raise `InputError` unless the results in the store are of the same job."""
        kept = self._group.attrs["job"]
        given = json.loads(json.dumps(asdict(job)))
        if kept != given:
            differing = [name for name in given if not isinstance(kept, dict) or kept.get(name) != given[name]]
            raise InputError(
                f"{self._folder}: its results differ from these in {' and '.join(differing)}: repeat those options,"
                " or give another --out"
            )

    def register(self, sources: Sequence[BatchInput]) -> tuple[list[tuple[int, BatchInput]], dict[Path, str]]:
        """Give each recording a number in the store; return numbers and recordings, and why others have changed."""
        known = self._known()
        numbers = {record["fingerprint"]: number for number, record in enumerate(known)}
        folders = {record["folder"] for record in known}
        changed = {
            source.folder: f"{source.folder}: has changed since its results were written: give another --out"
            for source in sources
            if source.fingerprint not in numbers and str(source.folder) in folders
        }
        new = [source for source in sources if source.fingerprint not in numbers and source.folder not in changed]
        names = [*self._names(), *unique_names((source.folder for source in new), self._names())]
        numbers |= {source.fingerprint: len(known) + index for index, source in enumerate(new)}
        frames = [*(record["frames"] for record in known), *(source.frames for source in new)]
        for array in (*self._of_frames.values(), self._arrays[STATE]):
            array.resize((len(frames), max(frames, default=0), *array.shape[2:]))
        for name in (_RECORDING, _PROVENANCE, _FRAMES):
            self._arrays[name].resize((len(frames),))
        self._arrays[FRAME].resize((max(frames, default=0),))
        self._arrays[FRAME][:] = np.arange(max(frames, default=0))
        self._arrays[_FRAMES][:] = np.array(frames, np.int64)
        self._arrays[_RECORDING][:] = np.array(names, np.dtypes.StringDType())
        registered = [(numbers[source.fingerprint], source) for source in sources if source.fingerprint in numbers]
        for number, source in registered:
            if number >= len(known):
                self.write_provenance(number, source, {})
        with warnings.catch_warnings():  # Zarr readers other than Python's may ignore it
            warnings.filterwarnings("ignore", "Consolidated metadata", ZarrUserWarning)
            zarr.consolidate_metadata(self._group.store)  # xarray opens the store much faster
        return registered, changed

    def write_provenance(self, number: int, source: BatchInput, facts: Mapping[str, Any]) -> None:
        """Replace what is known of the origin of a recording's results."""
        record = {"folder": str(source.folder), "fingerprint": source.fingerprint, "frames": source.frames, **facts}
        self._arrays[_PROVENANCE][number] = json.dumps(record)

    def missing(self, number: int, source: BatchInput) -> list[range]:
        """Chosen frames of each block that is not done, or has damaged frames, which may be repaired."""
        folder, block = self._folder / STATE / "c" / str(number), self._arrays[STATE].chunks[1]
        done = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        state, chosen = np.asarray(self._arrays[STATE][number]), source.chosen
        return [
            range(max(first, chosen.start), min(first + block, chosen.stop))
            for first in range(chosen.start // block * block, chosen.stop, block)
            if str(first // block) not in done or DAMAGED in state[first : first + block]
        ]

    def count(self, number: int, source: BatchInput) -> int:
        """Number of frames of a recording that have a wavefront."""
        return int(np.count_nonzero(np.asarray(self._arrays[STATE][number, : source.frames]) == WAVEFRONT))

    def write(self, number: int, frames: range, pieces: Iterable[xr.Dataset], damaged: Iterable[int]) -> None:
        """Write the results of one block; `pieces` adds the indices of damaged frames to `damaged` meanwhile."""
        values: dict[str, NDArray[Any]] = {
            name: np.full((len(frames), *array.shape[2:]), array.fill_value, array.dtype)
            for name, array in self._of_frames.items()
        }
        state = np.full(len(frames), NO_WAVEFRONT, np.uint8)
        for piece in pieces:
            self._check_alike(piece)
            at = piece["recording_index"].values - frames.start
            state[at] = WAVEFRONT
            for name, block in values.items():
                block[at] = piece[name].values
        state[[index - frames.start for index in damaged]] = DAMAGED
        for name, block in values.items():
            self._of_frames[name][number, frames.start : frames.stop] = block
        self._arrays[STATE][number, frames.start : frames.stop] = state

    def _check_alike(self, piece: xr.Dataset) -> None:
        """Raise `InputError` unless results have the sizes and coordinates of the store."""
        sizes: dict[Any, int] = {FRAME: piece.sizes[FRAME]}
        for array in self._of_frames.values():
            sizes |= zip(_dimensions(array)[2:], array.shape[2:], strict=True)
        differing = {str(name) for name, _ in sizes.items() ^ piece.sizes.items()}
        if not differing:
            along = [name for name in piece.coords if FRAME not in piece[name].dims and piece[name].dtype.kind == "f"]
            differing = {str(name) for name in along if not np.array_equal(piece[name], self._arrays[str(name)][:])}
        if differing:
            why = f"its results do not fit the store, which has another {' and '.join(sorted(differing))}"
            raise InputError(f"{why}: fix warp and modes by --set, or give another --out")

    def _known(self) -> list[dict[str, Any]]:
        """Provenance of all registered recordings; the last ones may not be registered completely."""
        texts = [str(text) for text in np.asarray(self._arrays[_PROVENANCE][:])]
        return [json.loads(text) for text in texts[: texts.index("") if "" in texts else None]]

    def _names(self) -> list[str]:
        return [str(name) for name in np.asarray(self._arrays[_RECORDING][:])][: len(self._known())]


def _make(group: zarr.Group, name: Any, dims: Iterable[Any], attributes: Mapping[Any, Any], **array: Any) -> None:
    simple = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in attributes.items()}
    names = [str(each) for each in dims]
    group.create_array(str(name), dimension_names=names, attributes=simple, overwrite=True, **array)


def _dimensions(array: zarr.Array[Any]) -> tuple[str, ...]:
    return tuple(map(str, array.metadata.dimension_names or ()))  # type: ignore[union-attr] # always of version 3


def is_store(folder: Path) -> bool:
    """True if a folder holds a whole store; a run may have been killed while it made one."""
    return "job" in store_attributes(folder)


def store_attributes(folder: Path) -> dict[str, Any]:
    """Attributes of a store; empty if the folder holds none."""
    try:
        attributes = json.loads((folder / METADATA).read_text("utf-8"))["attributes"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}
    return attributes if isinstance(attributes, dict) and attributes.get("format") == FORMAT else {}


def open_store(folder: Path) -> xr.Dataset:
    """Open a store for reading, arrays when they are used; `InputError` if the folder holds none."""
    if not is_store(folder):
        raise InputError(f"{folder}: holds no results of svwfs batch; svwfs.open_recording opens a recording")
    try:
        results: xr.Dataset = xr.open_zarr(folder, consolidated=True)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder}: cannot be read as results of svwfs batch: {in_words(error)}") from error
    return results


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchJob:
    """How each recording is reconstructed. Another version of the software may compute other bits."""

    bench: str = ""  # TOML text of another bench; empty: each recording's own
    settings: tuple[str, ...] = ()  # changes of the recorded benches
    rounds: int = 0  # of refinement, at most
    frames: str = ""  # of each recording, FIRST:END; empty: all
    software: str = _SOFTWARE

    def check_software(self) -> None:
        """Raise `RunError` unless this process runs the same version of svwfs."""
        if self.software != _SOFTWARE:
            raise RunError(f"a worker runs another version than {self.software}: install the same everywhere")

    @property
    def change(self) -> Change:
        """The change of a recorded calibration; it registers in one thread, as each worker has one core."""
        other = change_of(parse_bench(self.bench, "the bench") if self.bench else None, self.settings)

        def change(calibration: Calibration) -> Calibration:
            changed = calibration if other is None else other(calibration)
            registration = replace(changed.bench.registration, threads=1)
            return replace(changed, bench=replace(changed.bench, registration=registration))

        return change


@dataclass(frozen=True, slots=True)
class BatchInput:
    """A complete recording, and the frames that are chosen of it."""

    folder: Path  # absolute
    fingerprint: str  # of run.json, which holds the time, the counts and the bench: the same for a copy
    frames: int
    chosen: range

    @classmethod
    def of(cls, folder: Path, chosen: str) -> Self:
        """Take the frames FIRST:END, or all, of a recording; `InputError` if it is not complete."""
        run = read_run(folder)
        if not run["complete"]:
            raise InputError(f"{folder}: is not complete: it still grows, or svwfs recover finishes it")
        frames = recorded_frames(run)
        if frames is None:
            raise InputError(f"{folder / RUN}: does not say how many frames it has; svwfs recover counts them")
        if not frames:
            raise InputError(f"{folder}: holds no frame")
        fingerprint = hashlib.sha256((folder / RUN).read_bytes()).hexdigest()[:16]
        return cls(folder.absolute(), fingerprint, frames, selected(chosen or None, frames, folder))


def unique_names(folders: Iterable[Path], taken: Iterable[str]) -> list[str]:
    """Name each folder by the fewest last parts of its path that are unique; number equal paths."""
    known, names = set(taken), list[str]()
    for folder in folders:
        parts = folder.parts[1:]
        shortest = ("/".join(parts[-count:]) for count in range(1, len(parts) + 1))
        numbered = (f"{parts[-1]}-{number}" for number in itertools.count(2))
        names.append(next(name for name in itertools.chain(shortest, numbered) if name not in known))
        known.add(names[-1])
    return names

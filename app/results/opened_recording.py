"""A recording for scripts and notebooks: its frames as a lazy array, and its results."""

from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from app.bench.config import Bench, parse_bench
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.progress import counted
from app.recording.reader import Recording
from app.recording.reprocess import reprocess
from app.results.dataset import results_in_pieces
from app.results.result_file import reading_results
from reconstruction.arrays import Image
from reconstruction.pictures import html, picture_of_frame


def open_recording(path: Path | str) -> "OpenedRecording":
    """Open a recording.

    Parameters
    ----------
    path
        Folder of the recording.

    Returns
    -------
    OpenedRecording
        `.frames` is a lazy array (frame, row, column) in counts with the coordinates `frame_index` and `time`;
        `.results()` is the dataset of all frames; `.bench`, `.dark`, `.reference` and `.run` are what it was made with.

    Raises
    ------
    InputError
        If the folder holds no recording.

    Examples
    --------
    >>> with svwfs.live(bench) as instrument:
    ...     folder = instrument.record("recording", frames=3)
    >>> recording = svwfs.open_recording(folder)
    >>> recording.frames.sizes["frame"], recording.results().sizes["frame"]
    (3, 3)
    """
    return OpenedRecording(path)


class OpenedRecording:
    """A recording on disk; frames are read when they are used."""

    def __init__(self, folder: Path | str) -> None:
        self._recording = Recording(folder)

    def __len__(self) -> int:
        return len(self._recording)

    @property
    def bench(self) -> Bench:
        """The bench at the beginning of the recording."""
        return self._recording.bench

    @property
    def run(self) -> dict[str, Any]:
        """Facts of the run as in `run.json`: times, devices, counts, note, software (docs/results.md)."""
        return self._recording.run

    @property
    def dark(self) -> Image | None:
        """Mean dark of the first calibrated frame, counts, (row, column); None if there is none."""
        calibration = self._calibration
        return None if calibration is None or calibration.dark is None else calibration.dark.mean

    @property
    def reference(self) -> Image | None:
        """Mean reference of the first calibrated frame, counts, (row, column); None if there is none."""
        return None if self._calibration is None else self._calibration.reference.mean

    def __repr__(self) -> str:
        rows, columns = self._recording.frame_shape if len(self) else (0, 0)
        facts = [f"{counted(len(self))} of {rows} x {columns} pixels", f"began {self.run.get('began', 'some time')}"]
        facts.append(self._recording.ended_early if self._recording.is_complete else "unfinished")
        facts.append(self.run.get("note", ""))
        return f"<Recording {self._recording.folder}: {'; '.join(filter(None, facts))}>"

    def _repr_html_(self) -> str:
        try:
            return html(repr(self), picture_of_frame(self._recording.pixels(0)))
        except InputError as error:  # no frame, or damaged
            return escape(f"{self!r} {error}")

    @cached_property
    def _calibration(self) -> Calibration | None:
        first = self._recording.first_calibration(range(len(self)))
        return None if first is None else self._recording.calibration(first)

    @cached_property
    def frames(self) -> xr.DataArray:
        """Frames in counts, (frame, row, column), read as they are used, with `frame_index` and `time` (s)."""
        lines = [self._recording.line(index) for index in range(len(self))]
        pixels = indexing.LazilyIndexedArray(_Pixels(self._recording))
        return xr.DataArray(
            xr.Variable(("frame", "row", "column"), pixels, {"units": "counts"}),
            coords={
                "frame_index": ("frame", [line.camera_index for line in lines], {"long_name": "the camera's count"}),
                "time": ("frame", [line.camera_time_s for line in lines], {"units": "s", "long_name": "exposure end"}),
            },
        )

    def results(self) -> xr.Dataset:
        """Results of all reconstructable frames, along `frame`; `recording_index` says which these are.

        Taken from `results.nc` if that has the bench of the recording, else reconstructed now. `InputError` if no frame
        can be reconstructed, or the settings changed between the frames.
        """
        path = self._recording.folder / "results.nc"
        if path.exists():
            with reading_results(path) as results:
                bench = str(results.attrs.get("bench", ""))
                if parse_bench(bench, f"{path}: bench") == self.bench:
                    return results.load()
        pieces = list(results_in_pieces((made, {}) for made in reprocess(self._recording)))
        if not pieces:
            raise InputError(f"{self._recording.folder}: no frame can be reconstructed")
        try:
            return xr.concat(pieces, "frame", join="exact", coords="minimal", compat="override")
        except ValueError as error:
            raise InputError(f"{self._recording.folder}: the settings changed between the frames") from error


class _Pixels(BackendArray):
    """The pixels of a recording as an array that xarray reads frame by frame."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.shape = (len(recording), *recording.frame_shape)
        self.dtype = np.dtype(np.uint16)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> NDArray[Any]:
        support = indexing.IndexingSupport.BASIC
        return np.asarray(indexing.explicit_indexing_adapter(key, self.shape, support, self._read))

    def _read(self, key: tuple[int | slice, ...]) -> NDArray[np.uint16]:
        frame, *within = key
        if not isinstance(frame, slice):
            return self._recording.pixels(int(frame))[tuple(within)]
        chosen = range(*frame.indices(self.shape[0]))
        if not chosen:
            return np.empty((0, *np.empty(self.shape[1:])[tuple(within)].shape), np.uint16)
        return np.stack([self._recording.pixels(index)[tuple(within)] for index in chosen])

"""Results of recorded frames, so many at a time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice

import xarray as xr

from app.recording.reprocess import Reprocessed
from app.results.dataset import result_dataset, stack_frames
from app.results.view_quality import Variable, about

_PIECE = 32  # frames in memory at once


def results_in_pieces(frames: Iterable[tuple[Reprocessed, Mapping[str, Variable]]]) -> Iterator[xr.Dataset]:
    """Put the results of frames, each with some more variables, along `frame`; those without a wavefront are left out.

    `recording_index` says which they are.
    """
    made = ((frame, more) for frame, more in frames if frame.wavefront is not None)
    while piece := list(islice(made, _PIECE)):
        yield _stacked(piece)


def _stacked(piece: list[tuple[Reprocessed, Mapping[str, Variable]]]) -> xr.Dataset:
    datasets = [
        result_dataset(frame.wavefront).assign(more)
        for frame, more in piece
        if frame.wavefront is not None and frame.calibration is not None
    ]
    frames = [frame for frame, _ in piece]
    stacked = stack_frames(
        datasets,
        [frame.line.camera_index for frame in frames],
        [frame.line.camera_time_s for frame in frames],
        [_bias_age_s(frame) for frame in frames],
    )
    index = about("1", "the frame's index in the recording")
    return stacked.assign_coords(recording_index=("frame", [frame.line.index for frame in frames], index))


def _bias_age_s(frame: Reprocessed) -> float:
    age_s = frame.line.bias_age_s
    return math.nan if age_s is None or not frame.is_refined else age_s

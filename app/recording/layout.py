"""The names in a recording's folder; docs/recording.md says what each holds."""

from __future__ import annotations

from pathlib import Path

FORMAT = "svwfs recording 1"

RUN = "run.json"
FRAMES = "frames.jsonl"
STORE = "frames.zarr"
PIXELS = "0"  # the array of frames within the store, as OME-NGFF names the finest of its scales
BEFORE = -1  # in the place of a frame's index: one before the recording began


def results_of(calibration: int | str) -> str:
    """The group within the store that holds what came of the frames of one calibration."""
    return f"results/{calibration}"


def calibration_folder(folder: Path, number: int) -> Path:
    """Where a recording keeps a calibration."""
    return folder / "calibrations" / str(number)


def bias_file(folder: Path, number: int) -> Path:
    """Where a recording keeps a bias (lenslet_row, lenslet_column, field_mode, xy), px."""
    return folder / "biases" / f"{number}.npy"


def start_file(folder: Path) -> Path:
    """Where a recording keeps how the frame before its first was registered, px."""
    return folder / "start.npy"

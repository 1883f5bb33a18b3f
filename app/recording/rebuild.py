"""Rebuilding the metadata of a recording from its other files."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.bench.bench_files import read_bench_text
from app.errors import InputError
from app.recording.calibration_files import read_calibration
from app.recording.folder import CALIBRATION, FORMAT, FRAME_LINES, PIXELS, RESULTS, RUN, STORE, damaged_name
from app.recording.frame_array import METADATA, FrameArray
from app.recording.writer import make_array, make_store
from app.run_facts import write_record


def rebuild_run(folder: Path) -> str:
    """Make `run.json` again, as far as it is known, if it is missing or no JSON; return what was done."""
    run, bench, lines = folder / RUN, folder / CALIBRATION.format(0) / "bench.toml", folder / FRAME_LINES
    if not _is_lost(run) or not lines.is_file() or not lines.stat().st_size or not bench.is_file():
        return ""
    kept = ""
    if run.exists() and run.stat().st_size:
        kept = f"; the damaged one is {run.rename(damaged_name(run)).name}"
    write_record(run, {"format": FORMAT, "complete": False, "bench": read_bench_text(bench)})
    return f"{RUN} was missing or damaged and is made again, with the bench of the first calibration{kept}"


def _is_lost(path: Path) -> bool:
    """True if there is no file, or no JSON in it."""
    if not path.is_file():
        return not path.exists()
    try:
        json.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError):
        return True
    return False


def rebuild_arrays(folder: Path) -> Iterator[str]:
    """Make missing or damaged metadata of the arrays again; yield what was done."""
    store = folder / STORE
    if not store.is_dir():
        return
    if not (store / METADATA).is_file():
        make_store(store)
        yield f"{STORE}/{METADATA} was missing and is made again"
    for name in _without_metadata(store):
        metadata = store / name / METADATA
        try:
            values = _zeros_of_a_frame(folder, name)
            if metadata.exists():
                metadata.rename(metadata.with_name(f"damaged.{METADATA}"))
            make_array(store, name, values)
            yield f"{STORE}/{name}/{METADATA} was missing or damaged and is made again"
        except InputError as error:
            yield f"{STORE}/{name}/{METADATA} is missing or damaged and cannot be made again: {error}"


def _without_metadata(store: Path) -> Iterator[str]:
    """Names of the arrays whose metadata cannot be read."""
    for path in (store / PIXELS, *sorted(store.glob(RESULTS.format("*") + "/*"), reverse=True)):
        if path.is_dir():
            try:
                FrameArray(path)
            except InputError:
                yield path.relative_to(store).as_posix()


def _zeros_of_a_frame(folder: Path, name: str) -> NDArray[np.uint16] | NDArray[np.float64]:
    """Return zeros of the shape and type that one frame has in an array; `InputError` if no calibration tells it."""
    size = _chunk_bytes(folder / STORE / name)
    group, _, kind = name.rpartition("/")
    calibration = read_calibration(folder / CALIBRATION.format(group.rpartition("/")[2] or 0))
    sensor = calibration.bench.sensor
    lenslets = sensor.lenslet_rows, sensor.lenslet_columns
    if name == PIXELS:
        pixels = np.zeros(calibration.reference.mean.shape, np.uint16)
        if size == pixels.nbytes:
            return pixels
    elif kind == "displacement" and size % (16 * lenslets[0] * lenslets[1]) == 0:
        return np.zeros((*lenslets, size // (16 * lenslets[0] * lenslets[1]), 2))
    elif kind == "coefficients":
        field_modes = FrameArray(folder / STORE / group / "displacement").shape[2]
        if size % (8 * field_modes) == 0:
            return np.zeros((size // (8 * field_modes), field_modes))
    raise InputError(f"the chunks of {name} do not fit the calibration")


def _chunk_bytes(array: Path) -> int:
    """Size of the largest chunk; a last one may be cut short."""
    chunks = array.glob("c/*/0/0" if array.name == PIXELS else "c.*")
    return max((chunk.stat().st_size for chunk in chunks), default=0)

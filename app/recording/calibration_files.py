"""Calibrations on disk: `bench.toml` with the lattice, dark and reference, `camera.json`."""

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from app.bench.bench_files import read_bench_text
from app.bench.config import parse_bench, save_bench
from app.errors import InputError
from app.files import atomic_write, check_readable, in_words, sync
from app.images import MOST_COUNTS
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.run_facts import write_record
from reconstruction.arrays import Floats, reading_npy
from reconstruction.runtime.renaming import rename

# RuntimeError: the archive is encrypted
_DAMAGED = (OSError, ValueError, TypeError, KeyError, EOFError, MemoryError, RuntimeError, BadZipFile)


def write_calibration(folder: Path, calibration: Calibration) -> None:
    """Write a calibration into its own folder (atomic)."""
    temporary = folder.with_name(f".{folder.name}.partial")
    temporary.mkdir(parents=True)
    bench = replace(calibration.bench, lattice=calibration.lattice)
    try:
        save_bench(temporary / "bench.toml", bench)
        write_record(temporary / "camera.json", {"full_scale": calibration.full_scale})
        _write_average(temporary / "reference.npz", calibration.reference)
        if calibration.dark is not None:
            _write_average(temporary / "dark.npz", calibration.dark)
        rename(temporary, folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    sync(folder.parent)
    sync(folder.parent.parent)


def read_calibration(folder: Path) -> Calibration:
    """Read a calibration; `InputError` if it is missing or damaged."""
    bench = parse_bench(read_bench_text(folder / "bench.toml"), str(folder / "bench.toml"))
    check_readable(folder / "camera.json")
    try:
        full_scale = float(json.loads((folder / "camera.json").read_text("utf-8"))["full_scale"])
        if not 0 < full_scale <= MOST_COUNTS:
            raise ValueError(f"full_scale = {full_scale}")  # noqa: TRY301 - one way out
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"{folder / 'camera.json'}: cannot be read: {in_words(error)}") from error
    if bench.lattice is None:
        raise InputError(f"{folder / 'bench.toml'}: lattice is missing")
    dark = folder / "dark.npz"
    return Calibration(
        bench=bench,
        dark=_read_average(dark) if dark.exists() else None,
        reference=_read_average(folder / "reference.npz"),
        lattice=bench.lattice,
        full_scale=full_scale,
    )


def write_array(path: Path, values: Floats) -> None:
    """Write an array of any shape as NPY (atomic)."""
    with atomic_write(path) as temporary:
        np.save(temporary, values, allow_pickle=False)


def read_array(path: Path) -> Floats:
    """Read an array; `InputError` if it is missing or damaged."""
    check_readable(path)
    try:
        with reading_npy():
            values: Floats = np.load(path, allow_pickle=False)
        if not isinstance(values, np.ndarray) or values.dtype.kind != "f":
            raise ValueError("it holds no array of numbers")  # noqa: TRY301 - one way out
    except (OSError, ValueError, EOFError, MemoryError, BadZipFile) as error:
        raise InputError(f"{path}: cannot be read: {in_words(error)}") from error
    return values


def _write_average(path: Path, average: Average) -> None:
    values = {field.name: getattr(average, field.name) for field in fields(Average)}
    with atomic_write(path) as temporary:
        np.savez(temporary, allow_pickle=False, **values)


def _read_average(path: Path) -> Average:
    check_readable(path)
    try:
        with reading_npy(), path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {field.name: stored[field.name] for field in fields(Average)}
        average = Average(**{name: array if array.ndim else array.item() for name, array in arrays.items()})
    except _DAMAGED as error:
        raise InputError(f"{path}: cannot be read: {in_words(error)}") from error
    return average

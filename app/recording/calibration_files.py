"""Calibrations on disk: `bench.toml` with the lattice in force, `dark.npz`, `reference.npz`, `camera.json`."""

import json
from dataclasses import fields, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from app.bench.config import load_bench, write_bench
from app.errors import InputError
from app.files import atomic_write
from app.measurement.calibration import Calibration
from app.measurement.routines.averages import Average
from reconstruction.arrays import Floats


def write_calibration(folder: Path, calibration: Calibration) -> None:
    """Write a calibration into its own folder (atomic)."""
    temporary = folder.with_name(f".{folder.name}.partial")
    temporary.mkdir(parents=True)
    bench = replace(calibration.bench, lattice=calibration.lattice)
    (temporary / "bench.toml").write_text(write_bench(bench), "utf-8")
    (temporary / "camera.json").write_text(json.dumps({"full_scale": calibration.full_scale}) + "\n")
    _write_average(temporary / "reference.npz", calibration.reference)
    if calibration.dark is not None:
        _write_average(temporary / "dark.npz", calibration.dark)
    temporary.rename(folder)


def read_calibration(folder: Path) -> Calibration:
    """Read a calibration, bit-identical; `InputError` if it is missing or damaged."""
    bench = load_bench(folder / "bench.toml", is_recorded=True)
    try:
        full_scale = float(json.loads((folder / "camera.json").read_text())["full_scale"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder / 'camera.json'}: cannot be read: {error}") from error
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
    """Write an array as NPY (atomic)."""
    with atomic_write(path) as temporary:
        np.save(temporary, values, allow_pickle=False)


def read_array(path: Path) -> Floats:
    """Read an array; `InputError` if it is missing or damaged."""
    try:
        values: Floats = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    return values


def _write_average(path: Path, average: Average) -> None:
    np.savez(path, allow_pickle=False, **{field.name: getattr(average, field.name) for field in fields(Average)})


def _read_average(path: Path) -> Average:
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {field.name: stored[field.name] for field in fields(Average)}
        return Average(**{name: array if array.ndim else array.item() for name, array in arrays.items()})
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error

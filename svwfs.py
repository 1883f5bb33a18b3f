"""Python interface of svwfs: wavefronts at every position of the field, from frames that are arrays.

>>> import svwfs
>>> bench = svwfs.load_bench("small_demo")  # a preset, or the path of your TOML file
>>> images = svwfs.simulate(bench)  # in place of your own
>>> reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
>>> wavefront = reconstruct(images.frames[0])

The examples of all functions go on from there. Arrays are NumPy arrays with `[row, column]`, row = y; vectors have (x, y) as
their last axis; units are SI, wavefronts are in rad without piston. Importing this module loads nothing but this file
and four empty packages; each function loads what it needs.
"""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr

    from app.acquisition.session import ConnectedBench, LiveBench, connect, live
    from app.bench.config import Bench
    from app.errors import InputError, Interrupted, RunError
    from app.evaluation.frames import SimulatedFrames, simulate
    from app.measurement.measurement import Measurement
    from app.measurement.offline_reconstructor import OfflineReconstructor, find_lattice, reconstructor, refine
    from app.results.coefficients import field_coefficients
    from app.results.corrector import find_corrector
    from app.results.deconvolution import deconvolve
    from app.results.layers import find_layers
    from app.results.opened_recording import OpenedRecording, open_recording
    from app.results.point_spread import psf
    from drivers.errors import (
        BadValue,
        Busy,
        DeviceError,
        DeviceTimeout,
        Disconnected,
        FrameLost,
        Unsupported,
        WrongState,
    )
    from reconstruction.displacement import Displacement, LensletStatus
    from reconstruction.errors import ReconstructionError
    from reconstruction.geometry import Lattice
    from reconstruction.wavefront import Wavefront

__all__ = ["connect", "deconvolve", "field_coefficients", "find_corrector", "find_lattice", "find_layers", "live"]
__all__ += ["load_bench", "open_recording", "open_result", "psf", "reconstructor", "refine", "save_result", "simulate"]
__all__ += ["Bench", "ConnectedBench", "Displacement", "Lattice", "LiveBench", "OfflineReconstructor", "to_dataset"]
__all__ += ["LensletStatus", "Measurement", "OpenedRecording", "SimulatedFrames", "Wavefront"]
__all__ += ["BadValue", "Busy", "DeviceError", "DeviceTimeout", "Disconnected", "FrameLost", "InputError"]
__all__ += ["Interrupted", "ReconstructionError", "RunError", "Unsupported", "WrongState"]

_PACKAGES = ("app", "drivers", "reconstruction", "simulated_devices")


def _bind_packages() -> None:
    """Import the four packages from the folder of svwfs, whatever has their names in the working folder.

    They lie beside this file in a checkout, beside its folder when installed, elsewhere in an editable install.
    """
    beside = [*Path(__file__).resolve().parents[:2], *map(Path, sys.path)]
    whole = (each for each in beside if all((each / name / "__init__.py").is_file() for name in _PACKAGES))
    folder = next(whole, beside[0]).resolve()
    for name in _PACKAGES:
        if (loaded := sys.modules.get(name)) is not None:
            places = [*getattr(loaded, "__path__", [])]
            if folder / name not in (Path(place).resolve() for place in places):
                taken = getattr(loaded, "__file__", None) or places[0]
                raise ImportError(f"svwfs has a package {name!r}, but {taken} was imported by this name: rename it")
        elif (spec := PathFinder.find_spec(name, [str(folder)])) and spec.loader:
            sys.modules[name] = module = module_from_spec(spec)
            spec.loader.exec_module(module)


_bind_packages()

_ELSEWHERE = {
    "app.acquisition.session": "ConnectedBench LiveBench connect live",
    "app.bench.config": "Bench",
    "app.cli": "main",  # of the command
    "app.cli.window": "main_window",
    "app.errors": "InputError Interrupted RunError",
    "app.evaluation.frames": "SimulatedFrames simulate",
    "app.measurement.offline_reconstructor": "OfflineReconstructor find_lattice reconstructor refine",
    "app.measurement.measurement": "Measurement",
    "app.results.coefficients": "field_coefficients",
    "app.results.corrector": "find_corrector",
    "app.results.deconvolution": "deconvolve",
    "app.results.layers": "find_layers",
    "app.results.opened_recording": "OpenedRecording open_recording",
    "app.results.point_spread": "psf",
    "drivers.errors": "BadValue Busy DeviceError DeviceTimeout Disconnected FrameLost Unsupported WrongState",
    "reconstruction.displacement": "Displacement LensletStatus",
    "reconstruction.errors": "ReconstructionError",
    "reconstruction.geometry": "Lattice",
    "reconstruction.wavefront": "Wavefront",
}


def load_bench(source: str | Path, *overrides: str) -> Bench:
    """Read a bench from a TOML file or a preset.

    Parameters
    ----------
    source
        Path of a TOML file, or one of the presets `recommended`, `live_demo`, `small_demo`, `paper_simulation` and
        `paper_experiment`.
    *overrides
        Single settings as "section.key=value".

    Returns
    -------
    Bench
        The configuration, with the sections of the file as attributes; it cannot be changed.

    Raises
    ------
    InputError
        If the file or a setting cannot be used; the message names the key.

    Examples
    --------
    >>> svwfs.load_bench("live_demo", "camera.exposure_s=0.05").camera.exposure_s
    0.05
    """
    from app.bench.config import load_bench as load

    return load(source, overrides)


def to_dataset(wavefront: Wavefront) -> xr.Dataset:
    """Turn a wavefront into a dataset with names and units (docs/results.md).

    Parameters
    ----------
    wavefront
        A reconstructed wavefront.

    Returns
    -------
    xarray.Dataset
        `wavefront(view_row, view_column, lenslet_row, lenslet_column)` in rad with `wavefront_sigma`, displacements in
        px, coefficients in rad, image quality; every variable has its unit.

    Examples
    --------
    >>> svwfs.to_dataset(wavefront)["wavefront"].attrs["units"]
    'rad'
    """
    from app.results.dataset import result_dataset
    from app.results.sources import measured

    return result_dataset(measured(wavefront)).copy(deep=True)  # values in it may be changed


def save_result(path: str | Path, wavefront: Wavefront, bench: Bench) -> None:
    """Write the dataset of a wavefront to a NetCDF file, with the bench as an attribute.

    Parameters
    ----------
    path
        The file, ending in .nc; it appears under its name only when it is complete.
    wavefront
        A reconstructed wavefront.
    bench
        The bench it was reconstructed with; `reconstructor.bench` includes the lattice.

    Raises
    ------
    InputError
        If the name is that of another format, or the wavefront was measured with another bench.
    RunError
        If the file cannot be written.

    Examples
    --------
    >>> svwfs.save_result("result.nc", wavefront, bench)
    """
    from dataclasses import replace

    from app.bench.config import as_bench
    from app.errors import InputError
    from app.files import check_suffix
    from app.results.dataset import result_dataset
    from app.results.result_file import write_results
    from app.results.sources import measured

    check_suffix(Path(path), ".nc")
    known, found = as_bench(bench), measured(wavefront).sensor
    rows = known.sensor.lenslet_rows or found.lenslet_rows
    columns = known.sensor.lenslet_columns or found.lenslet_columns
    sensor = replace(known.sensor, pupil=found.pupil, lenslet_rows=rows, lenslet_columns=columns)  # as it was found
    if (sensor, known.field) != (found, wavefront.field):
        raise InputError("the wavefront was measured with another sensor or field than the bench's")
    write_results(Path(path), result_dataset(wavefront), bench=replace(known, sensor=sensor), inputs={})


def open_result(path: str | Path) -> xr.Dataset:
    """Open results that `svwfs reconstruct`, `measure`, `replay`, `batch` or `save_result` wrote.

    Parameters
    ----------
    path
        NetCDF file, or the Zarr store of `svwfs batch` (docs/sharing.md).

    Returns
    -------
    xarray.Dataset
        The results; arrays are read when they are used. Close it, or use it in a `with` block.

    Raises
    ------
    InputError
        If the file or folder is missing, damaged, or holds no results.

    Examples
    --------
    >>> svwfs.save_result("result.nc", wavefront, bench)
    >>> with svwfs.open_result("result.nc") as result:
    ...     result["rms"].dims
    ('view_row', 'view_column')
    """
    from app.batch.store import open_store
    from app.results.result_file import open_results

    return open_store(Path(path)) if Path(path).is_dir() else open_results(path)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("svwfs")
    for module, names in _ELSEWHERE.items():
        if name in names.split():
            return getattr(import_module(module), name)
    raise AttributeError(f"module 'svwfs' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

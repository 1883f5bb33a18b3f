"""Python interface of svwfs: wavefronts at every position of the field, from frames that are arrays.

>>> import svwfs
>>> bench = svwfs.load_bench("small_demo")  # a preset, or the path of your TOML file
>>> images = svwfs.simulate(bench)  # in place of your own
>>> reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
>>> wavefront = reconstruct(images.frames[0])

The examples of all functions go on from there. Arrays are NumPy arrays with `[row, column]`, row = y; vectors have (x, y) as
their last axis; units are SI, wavefronts are in rad without piston. Importing this module loads nothing but this file;
each function loads what it needs.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import xarray as xr

    from app.acquisition.session import ConnectedBench, LiveBench, connect, live
    from app.bench.config import Bench
    from app.errors import InputError, Interrupted, RunError
    from app.evaluation.frames import SimulatedFrames, simulate
    from app.measurement.bench_reconstructor import BenchReconstructor, find_lattice, reconstructor, refine
    from app.measurement.measurement import Measurement
    from app.results.opened_recording import OpenedRecording, open_recording
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
    from reconstruction.arrays import Counts
    from reconstruction.deconvolution.corrected_image import PhaseAt, RestorationMethod
    from reconstruction.displacement import Displacement, Outcome
    from reconstruction.errors import ReconstructionError
    from reconstruction.geometry import Lattice
    from reconstruction.settings import PupilBasis
    from reconstruction.wavefront import Wavefront

__all__ = ["connect", "deconvolve", "field_coefficients", "find_corrector", "find_lattice", "find_layers", "live"]
__all__ += ["load_bench", "open_recording", "open_result", "psf", "reconstructor", "refine", "save_result", "simulate"]
__all__ += ["Bench", "BenchReconstructor", "ConnectedBench", "Displacement", "Lattice", "LiveBench", "to_dataset"]
__all__ += ["Measurement", "OpenedRecording", "Outcome", "SimulatedFrames", "Wavefront"]
__all__ += ["BadValue", "Busy", "DeviceError", "DeviceTimeout", "Disconnected", "FrameLost", "InputError"]
__all__ += ["Interrupted", "ReconstructionError", "RunError", "Unsupported", "WrongState"]

_ELSEWHERE = {
    "app.acquisition.session": "ConnectedBench LiveBench connect live",
    "app.bench.config": "Bench",
    "app.errors": "InputError Interrupted RunError",
    "app.evaluation.frames": "SimulatedFrames simulate",
    "app.measurement.bench_reconstructor": "BenchReconstructor find_lattice reconstructor refine",
    "app.measurement.measurement": "Measurement",
    "app.results.opened_recording": "OpenedRecording open_recording",
    "drivers.errors": "BadValue Busy DeviceError DeviceTimeout Disconnected FrameLost Unsupported WrongState",
    "reconstruction.displacement": "Displacement Outcome",
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


def psf(wavefront: Wavefront, x_m: float, y_m: float) -> xr.DataArray:
    """Point-spread function at one position of the field.

    Parameters
    ----------
    x_m, y_m
        Field position, m.

    Returns
    -------
    xarray.DataArray
        Intensity (angle_y, angle_x) over the peak of the unaberrated pupil, so 1 is diffraction-limited and the value
        at angle 0 is the Strehl ratio; the coordinates are field angles in rad.

    Raises
    ------
    ValueError
        If the position lies outside the field.

    Examples
    --------
    >>> image = svwfs.psf(wavefront, x_m=0.0, y_m=0.5e-3)
    >>> image.dims
    ('angle_y', 'angle_x')
    """
    import xarray as xr

    from reconstruction.quality.image_quality import psf as point_spread
    from reconstruction.quality.image_quality import psf_angles_rad, psf_reach_rad

    phase, sensor = _wavefront(wavefront).at(x_m, y_m), wavefront.sensor
    angle_rad = psf_angles_rad(sensor, psf_reach_rad(phase, sensor))
    values = point_spread(phase, sensor, angle_rad=angle_rad)
    angles = {name: (name, angle_rad, {"units": "rad"}) for name in ("angle_y", "angle_x")}
    return xr.DataArray(values, dims=("angle_y", "angle_x"), coords=angles, name="psf")


def find_layers(
    reconstructor: BenchReconstructor, wavefront: Wavefront, count: int = 1, *, distances_m: tuple[float, ...] = ()
) -> xr.Dataset:
    """Find at which distance in front of the lenslets the aberration originates, or behind them (docs/layers.md).

    Parameters
    ----------
    reconstructor
        Result of `svwfs.reconstructor`.
    wavefront
        A wavefront made by it.
    count
        Number of layers to look for, 1 or 2.
    distances_m
        Known distances of the layers, negative behind the lenslets; found if omitted.

    Returns
    -------
    xarray.Dataset
        `distance_m(layer)` and `layer_phase(layer, y, x)` with their errors, `chi_square(distance)` and `misfit` of a
        single layer, `model_misfit(model)`; the attribute `verdict` says how many layers explain the wavefront, and `doubt`
        why that may be wrong.

    Raises
    ------
    ReconstructionError
        If too few lenslets are valid, or the displacements do not change over the field.

    Examples
    --------
    >>> layers = svwfs.find_layers(reconstruct, reconstruct(images.frames[0]))
    >>> layers.attrs["verdict"]
    'one layer'
    >>> bool(abs(layers["distance_m"].item() - 0.195) < 0.005)  # as the bench says
    True
    """
    from app.results.layers import layers_dataset, ratio_at
    from reconstruction.layers.layer_search import find_layers as search

    ratios = tuple(ratio_at(distance_m, "lenslets", reconstructor.bench) for distance_m in distances_m)
    found = search(reconstructor.layers(_wavefront(wavefront)), count, at=ratios)
    return layers_dataset(found, reconstructor.bench, "lenslets")


def find_corrector(
    source: Wavefront | str | Path,
    bench: Bench,
    *,
    modes: Literal["zernike", "legendre", "actuators"] = "zernike",
    count: int = 45,
    distance_m: float | None = None,
) -> xr.Dataset:
    """Find what a corrector conjugate to each distance would leave, and its best command (docs/layers.md).

    Parameters
    ----------
    source
        A wavefront, a file of results, or the folder of a recording, whose frames are averaged.
    modes
        Shapes that the corrector can take over its footprint.
    count
        Number of modes, the piston included, or of actuators, which is a square.
    distance_m
        Distance of the corrector in front of the lenslets, negative behind them; the best one if omitted.

    Returns
    -------
    xarray.Dataset
        `residual(distance)` in rad and `strehl(distance)` over the distance from the lenslets, `uncorrected` in rad;
        `corrector_distance_m`, `corrector_residual`, `command(shape)` and `command_phase(y, x)` in rad of one corrector.

    Raises
    ------
    InputError
        If source, modes or distance cannot be used; the message says why.

    Examples
    --------
    >>> found = svwfs.find_corrector(wavefront, bench)
    >>> bool(abs(found["corrector_distance_m"] - 0.195) < 0.01)  # that of the screen
    True
    >>> bool(found["corrector_residual"] < 0.1 * found["residual"].sel(distance=0))
    True
    """
    from app.bench.config import as_bench
    from app.errors import InputError
    from app.results.corrector import compare_correctors
    from reconstruction.layers.corrector import Corrector

    bench = as_bench(bench)
    phase_at = _phase_at(source, bench)
    try:
        return compare_correctors(phase_at, bench, Corrector(modes, count), distance_m, "lenslets")[0]
    except ValueError as error:
        raise InputError(str(error)) from error


def field_coefficients(
    wavefront: Wavefront, basis: PupilBasis = "zernike", *, order: int | None = None, positions: int = 21
) -> xr.Dataset:
    """Map the coefficients of a wavefront over the field, and write it in double Zernikes (docs/field.md).

    Parameters
    ----------
    wavefront
        A wavefront of the modal method.
    basis
        Zernike modes over the circle inscribed in the lattice, or Legendre modes over the whole lattice.
    order
        Highest degree of the modes; by default all that were fitted, which is exact.
    positions
        Number of field positions along each side.

    Returns
    -------
    xarray.Dataset
        `coefficient(mode, y, x)` and `coefficient_sigma` in rad, at field positions in m. With Zernike modes also
        `double_zernike(k, j)` and `double_zernike_sigma` in rad, and the radii of field and pupil, m, as attributes,
        named as the arguments of `galsim.zernike.DoubleZernike`.

    Raises
    ------
    ReconstructionError
        If the wavefront has no coefficients, or not of this order.

    Examples
    --------
    >>> field = svwfs.field_coefficients(wavefront, order=4)
    >>> field["coefficient"].sel(mode=4)["name"].item()  # Noll's count
    'Z4 defocus'
    """
    from app.results.coefficients import field_dataset
    from reconstruction.field_coefficients import ModalFit
    from reconstruction.field_coefficients import field_coefficients as coefficients

    found = coefficients(ModalFit.of(_wavefront(wavefront)), basis, order)
    return field_dataset(found, wavefront.sensor, wavefront.field, positions)


def deconvolve(
    image: Counts,
    source: Wavefront | str | Path,
    bench: Bench,
    *,
    method: RestorationMethod = "richardson-lucy",
    iterations: int = 50,
) -> xr.DataArray:
    """Remove the aberration of each field position from an image of the sample (docs/corrected_images.md).

    Parameters
    ----------
    image
        Counts, (row, column), taken through the same sample.
    source
        A wavefront, a file of results, or the folder of a recording, whose frames are averaged.
    bench
        The bench; its `[imaging]` has the scale of the image, and its pupil.
    method
        Richardson-Lucy keeps light positive; Wiener is faster.
    iterations
        At most; it ends earlier when only noise is left.

    Returns
    -------
    xarray.DataArray
        Corrected counts (row, column), float32, with the coordinate `inside`: True within the measured field, beyond
        which the image is as before. The attributes have `iterations` and `chi_square`.

    Raises
    ------
    InputError
        If image, wavefront and bench do not go together; the message says why.

    Examples
    --------
    >>> bench = svwfs.load_bench("small_demo", "imaging.pixel_m=10e-6")
    >>> image = images.frames[0]  # here your own image of the sample
    >>> corrected = svwfs.deconvolve(image, wavefront, bench, iterations=3)
    >>> corrected.shape, bool(corrected.inside.any())
    ((240, 256), True)
    """
    from app.bench.config import as_bench
    from app.measurement.bench_reconstructor import as_image
    from app.results.deconvolution import correct

    phase_at, bench = _phase_at(source, bench), as_bench(bench)
    made = correct(
        as_image(image, "image"),
        phase_at,
        bench,
        method=method,
        iterations=iterations,
        progress=lambda *_: None,
        name="image",
    )
    return made["image"].rename(None).assign_coords(inside=made["inside"]).assign_attrs(units="counts", **made.attrs)


def to_dataset(wavefront: Wavefront) -> xr.Dataset:
    """Turn a wavefront into a dataset with names and units (docs/results.md).

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

    return result_dataset(_wavefront(wavefront))


def save_result(path: str | Path, wavefront: Wavefront, bench: Bench) -> None:
    """Write the dataset of a wavefront to a NetCDF file, with the bench as an attribute.

    Parameters
    ----------
    path
        The file, ending in .nc; it appears under its name only when it is complete.
    bench
        The bench it was reconstructed with; `reconstructor.bench` includes the lattice.

    Raises
    ------
    InputError
        If the name is that of another format.
    RunError
        If the file cannot be written.

    Examples
    --------
    >>> svwfs.save_result("result.nc", wavefront, bench)
    """
    from app.bench.config import as_bench
    from app.files import check_suffix
    from app.results.dataset import result_dataset
    from app.results.result_file import write_results

    check_suffix(Path(path), ".nc")
    write_results(Path(path), result_dataset(_wavefront(wavefront)), bench=as_bench(bench), inputs={})


def open_result(path: str | Path) -> xr.Dataset:
    """Open results that `svwfs reconstruct`, `measure`, `replay`, `batch` or `save_result` wrote.

    Parameters
    ----------
    path
        NetCDF file, or the Zarr store of `svwfs batch` (docs/many_machines.md).

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


def _phase_at(source: Wavefront | str | Path, bench: Bench) -> PhaseAt:
    """Return the wavefront at any field position, of a wavefront, a file of results or a recording."""
    from app.bench.config import as_bench
    from app.results.sources import mean_wavefront

    if isinstance(source, str | Path):
        return mean_wavefront(Path(source), as_bench(bench), None, lambda *_: None)
    return _wavefront(source).at


def _wavefront(wavefront: object) -> Wavefront:
    """Refuse anything but a wavefront."""
    from app.errors import InputError
    from reconstruction.wavefront import Wavefront

    if not isinstance(wavefront, Wavefront):
        raise InputError(
            f"a wavefront is needed, not {type(wavefront).__name__}; Measurement.problem says why it is None"
        )
    return wavefront


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("svwfs")
    for module, names in _ELSEWHERE.items():
        if name in names.split():
            return getattr(import_module(module), name)
    raise AttributeError(f"module 'svwfs' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

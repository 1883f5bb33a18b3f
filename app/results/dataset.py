"""Results as NetCDF-4: wavefronts with coordinates, units and origin, for xarray, MATLAB or Panoply."""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5netcdf
import h5py
import numpy as np
import xarray as xr

from app.bench.config import Bench, write_bench
from app.errors import SETTINGS_CHANGED, InputError, RunError
from app.files import atomic_write, in_words
from app.results.assumed_layers import propagation, sample_variables
from app.results.hdf_file import HdfFile
from app.results.quality import quality_variable
from app.results.rotation import rotation_variables
from app.results.view_quality import Variable, about, point_spread, structure, transfer
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.quality.image_quality import psf
from reconstruction.quality.verdict import Quality
from reconstruction.solve.modal_solution import ModalSolution
from reconstruction.wavefront import Wavefront, peak_to_valley, rms

if TYPE_CHECKING:  # opening a file needs no reconstruction
    from app.recording.reprocess import Reprocessed

_PIECE = 32  # frames in memory at once
_FRAME = "frame"
_CHECKSUMS = "crc32"  # group with an attribute for each variable, which xarray does not copy to changed files
_LARGEST_PX = 1e6  # of a displacement
_VIEW = ("view_row", "view_column")
_LENSLET = ("lenslet_row", "lenslet_column")
_RANGE = "displacement of the field's edge over what the cell allows; above 1 it has left the cell"
_CHI_SQUARE = "reduced chi-square of the registered subimage; NaN where the camera's noise is not known"


def result_dataset(wavefront: Wavefront, quality: Quality | None = None, *, with_psf: bool = False) -> xr.Dataset:
    """Return all results of a wavefront, named as in docs/results.md; point-spread functions make them much larger."""
    displacement, solution = wavefront.displacement, wavefront.solution
    vectors, modes = (*_LENSLET, "field_mode", "xy"), ("pupil_mode", "field_mode")
    misfit = "RMS misfit of the registered subimage over the contrast of the brightest one"
    variables: dict[str, Variable] = {
        **_wavefront_variables(wavefront.views, wavefront.sensor),
        "wavefront_sigma": ((*_VIEW, *_LENSLET), wavefront.sigma(), about("rad", "standard deviation of wavefront")),
        "displacement": (vectors, displacement.coefficients, about("px", "coefficients of the field modes")),
        "displacement_sigma": (vectors, np.sqrt(displacement.variance), about("px", "standard deviation")),
        "valid": (_LENSLET, displacement.valid, about("1", "whether the lenslet yields a slope")),
        "outcome": (_LENSLET, displacement.outcome, about("1", "0 converged, else why the lenslet was lost")),
        "residual_rms": (_LENSLET, displacement.residual_rms, about("1", misfit)),
        "range_used": (_LENSLET, displacement.range_used, about("1", _RANGE)),
        "chi_square": (_LENSLET, displacement.chi_square, about("1", _CHI_SQUARE)),
    }
    if isinstance(solution, ModalSolution):
        sigma, chi_square = solution.coefficients_sigma, np.array(solution.chi_square)
        variables |= {
            "coefficients": (modes, solution.coefficients, about("rad", "e_pq")),
            "coefficients_sigma": (modes, sigma, about("rad", "standard deviation of e_pq")),
            "slope_chi_square": ((), chi_square, about("1", "reduced chi-square of the slopes against the fit")),
        }
    variables |= rotation_variables(wavefront) | sample_variables(wavefront.sample, wavefront.field)
    if quality is not None:
        variables["quality"] = quality_variable(quality)
    coordinates = _coordinates(wavefront.sensor, wavefront.field)
    for qualities in (transfer, structure, point_spread)[: 3 if with_psf else 2]:
        more, along = qualities(wavefront)
        variables |= more
        coordinates |= along
    attributes = propagation(wavefront.field)
    return xr.Dataset({**variables, "xy": ("xy", ["x", "y"])}, coords=coordinates, attrs=attributes)


def truth_dataset(views: Floats, light: Floats, bench: Bench) -> xr.Dataset:
    """Return a true wavefront and the light at the lenslets in the form of results.

    Parameters
    ----------
    views
        Wavefront, (view_row, view_column, lenslet_row, lenslet_column), rad.
    light
        Intensity relative to that without the sample, of the same shape.
    bench
        The bench that was simulated.
    """
    variables = {
        **_wavefront_variables(views, bench.sensor),
        "light": ((*_VIEW, *_LENSLET), light, about("1", "intensity at the lenslet centres over that without sample")),
    }
    return xr.Dataset(variables, coords=_coordinates(bench.sensor, bench.field), attrs=propagation(bench.field))


def results_in_pieces(
    frames: Iterable[tuple[Reprocessed, Mapping[str, Variable]]],
    results_of: Callable[[Wavefront, Quality], xr.Dataset] = result_dataset,
) -> Iterator[xr.Dataset]:
    """Stack the results of frames, with additional variables for each, along `frame`, in pieces that fit in memory.

    Frames without a wavefront are left out; the coordinate `recording_index` has the index in the recording.
    """
    made = (  # a wavefront holds megabytes of its solution: none is kept
        (results.assign(more) if more else results, frame.line, frame.bias_age_s)  # assign copies every variable
        for frame, more in frames
        if frame.wavefront is not None
        for results in [results_of(frame.wavefront, frame.quality)]
    )
    while piece := list(islice(made, _PIECE)):
        datasets, lines, ages_s = zip(*piece, strict=True)
        stacked = stack_frames(
            datasets,
            [line.camera_index for line in lines],
            [line.camera_time_s for line in lines],
            [math.nan if age_s is None else age_s for age_s in ages_s],
        )
        index = about("1", "the frame's index in the recording")
        yield stacked.assign_coords(recording_index=(_FRAME, [line.index for line in lines], index))


def stack_frames(
    datasets: Sequence[xr.Dataset], frame_index: Sequence[int], time_s: Sequence[float], bias_age_s: Sequence[float]
) -> xr.Dataset:
    """Stack results of several frames along a new first dimension `frame`; `InputError` if their settings differ."""
    first = datasets[0]
    for dataset in datasets:
        _require_alike(first.sizes, dataset.sizes)
        is_alike = set(first.data_vars) == set(dataset.data_vars)
        if not is_alike or any(not index.equals(dataset.indexes[name]) for name, index in first.indexes.items()):
            raise InputError(SETTINGS_CHANGED)
    stacked = {  # xarray.concat took a third of the time of a result, because it aligns every variable
        name: ((_FRAME, *variable.dims), np.stack([each.variables[name].values for each in datasets]), variable.attrs)
        for name, variable in first.data_vars.items()
    }
    return xr.Dataset(stacked, coords=first.coords, attrs=first.attrs).assign_coords(
        frame_index=(_FRAME, list(frame_index), about("1", "the camera's count since start")),
        time=(_FRAME, list(time_s), about("s", "end of the exposure on the camera's clock")),
        bias_age=(_FRAME, list(bias_age_s), about("s", "age of the bias that refined the frame; NaN: not refined")),
    )


def open_results(path: Path | str) -> xr.Dataset:
    """Open a file of results; arrays are read when they are used. `InputError` if it holds none, or is damaged."""
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file")
    try:
        _check_sums(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about files that are odd, which the next lines find
            dataset = xr.open_dataset(path, engine="h5netcdf")
    except InputError:
        raise
    except Exception as error:  # damaged files make HDF5 raise anything
        raise InputError(f"{path}: cannot be opened as results: it is not a NetCDF-4 file, or is damaged") from error
    if "wavefront" not in dataset:
        dataset.close()
        raise InputError(f"{path}: holds no results: there is no variable wavefront in it")
    return dataset


@contextmanager
def reading_results(path: Path) -> Iterator[xr.Dataset]:
    """Open results with plausible displacements; every error of a damaged file is an `InputError`."""
    with open_results(path) as results:
        try:
            _require_sound(path, results)
            yield results
        except (InputError, RunError):
            raise
        except Exception as error:
            raise InputError(f"{path}: is damaged: {type(error).__name__}: {in_words(error)}") from error


def _require_sound(path: Path, results: xr.Dataset) -> None:
    """Raise `InputError` if a frame has no valid lenslet, or a valid one a displacement that none can have."""
    if "valid" in results and "displacement" in results:
        valid = results["valid"].astype(bool)
        if not valid.any(_LENSLET).all():
            raise InputError(f"{path}: is damaged: it has a frame without a valid lenslet")
        if not (~valid | (abs(results["displacement"]) < _LARGEST_PX)).all():
            raise InputError(f"{path}: is damaged: a valid lenslet has a displacement that none can have")


def _check_sums(path: Path | str) -> None:
    """Raise `InputError` if a variable differs from what was written; files before 0.3 have no checksums."""
    with h5py.File(path, "r") as file:
        file.attrs.get("_nc3_strict")  # if that fails, h5netcdf fails with a traceback from its destructor, too
        for name, written in file[_CHECKSUMS].attrs.items() if _CHECKSUMS in file else ():
            variable, found = file[name], 0
            for first in range(0, variable.shape[0], _PIECE) if variable.ndim else (None,):
                found = _checksum(variable[... if first is None else slice(first, first + _PIECE)], found)
            if found != written:
                raise InputError(f"{path}: is damaged: {name} is not what was written; reconstruct the frames again")


def _checksum(values: Any, before: int = 0) -> int:
    """Return the CRC-32 of values that follow others with the checksum `before`."""
    values = np.asarray(values)
    if values.dtype.kind in "biuf":
        return zlib.crc32(values.tobytes(), before)
    texts = (each.encode() if isinstance(each, str) else each for each in values.flat)  # they are read as bytes
    return zlib.crc32(b"".join(text + b"\0" for text in texts), before)


def write_results(path: Path, dataset: xr.Dataset, *, bench: Bench, inputs: Mapping[str, str]) -> None:
    """Write a dataset with bench, software version and names of the inputs as attributes (atomic)."""
    write_pieces(path, [dataset], bench=bench, inputs=inputs)


def write_pieces(path: Path, pieces: Iterable[xr.Dataset], *, bench: Bench, inputs: Mapping[str, str]) -> None:
    """Write results of many frames as `write_results` does, one piece in memory at a time.

    `InputError` if a piece has another shape than the first, because the settings changed between them.
    """
    count, sums = 0, dict[Hashable, int]()
    with atomic_write(path) as temporary:
        for piece in pieces:
            if count:
                _append(temporary, piece)
            else:
                temporary.write_bytes(_netcdf(piece, bench, inputs))
            count += piece.sizes.get(_FRAME, 1)
            _verify(temporary, path, count)
            _add_sums(temporary, piece, sums)
        if not count:
            raise RunError(f"{path}: there is nothing to write: no frame has a wavefront")
        _verify(temporary, path, count)


def _add_sums(path: Path, piece: xr.Dataset, sums: dict[Hashable, int]) -> None:
    """Update the checksums of the variables, as they are stored, by those of a piece."""
    with HdfFile(path) as writable, h5netcdf.File(writable, "r+") as file:
        group = file.groups[_CHECKSUMS] if sums else file.create_group(_CHECKSUMS)
        for name, variable in piece.variables.items():
            if name not in sums or _FRAME in variable.dims:
                stored = file.variables[name]
                values = variable.values if variable.dtype.kind in "UO" else variable.values.astype(stored.dtype)
                sums[name] = _checksum(values, sums.get(name, 0))
                group.attrs[str(name)] = np.uint32(sums[name])


def _netcdf(piece: xr.Dataset, bench: Bench, inputs: Mapping[str, str]) -> memoryview:
    """Return the contents of a file. HDF5 crashes on a full disk, so it writes into memory."""
    origin = {"software": f"svwfs {version('svwfs')}", "bench": write_bench(bench), **inputs}
    origin = {
        name: text.encode(errors="replace").decode() for name, text in origin.items()
    }  # file names may be no text
    return piece.assign_attrs(**{"title": "Space-variant wavefront"} | piece.attrs | origin).to_netcdf(
        engine="h5netcdf", unlimited_dims=[_FRAME] if _FRAME in piece.dims else []
    )


def _verify(written: Path, path: Path, frames: int) -> None:
    """Raise `RunError` unless the file can be read and has all frames."""
    try:
        with h5netcdf.File(written, "r") as file:
            found = file.dimensions[_FRAME].size if _FRAME in file.dimensions else 1
    except OSError as error:
        raise RunError(f"{path}: cannot be read again: {in_words(error)}") from error
    if found != frames:
        raise RunError(f"{path}: only {found} of {frames} frames were written")


def _append(path: Path, piece: xr.Dataset) -> None:
    with HdfFile(path) as writable, h5netcdf.File(writable, "r+") as file:
        first = file.dimensions[_FRAME].size
        sizes = {name: dimension.size for name, dimension in file.dimensions.items() if name != _FRAME}
        _require_alike(sizes, {name: size for name, size in piece.sizes.items() if name != _FRAME})
        file.resize_dimension(_FRAME, first + piece.sizes[_FRAME])
        for name, variable in piece.variables.items():
            if _FRAME in variable.dims:
                stored = file.variables[name]
                stored[first:] = variable.values.astype(stored.dtype)


def _require_alike(sizes: Mapping[Hashable, int], others: Mapping[Hashable, int]) -> None:
    if dict(sizes) != dict(others):
        raise InputError(SETTINGS_CHANGED)


def _wavefront_variables(views: Floats, sensor: Sensor) -> dict[str, Variable]:
    strehl = psf(views, sensor, angle_rad=np.zeros(1))[..., 0, 0]
    return {
        "wavefront": ((*_VIEW, *_LENSLET), views, about("rad", "phase at the lenslet centres, piston removed")),
        "rms": (_VIEW, rms(views), about("rad", "RMS of each view's wavefront")),
        "strehl": (_VIEW, strehl, about("1", "Strehl ratio of each view's wavefront, tilt included")),
        "pv": (_VIEW, peak_to_valley(views), about("rad", "peak to valley of each view's wavefront")),
    }


def _coordinates(sensor: Sensor, field: Field) -> dict[str, Variable]:
    is_square = sensor.arrangement == "square"
    pupil_x_m = sensor.pupil_x_m if is_square else sensor.lenslet_centers_m[..., 0]
    return {
        "view_x": (("view_column",), field.view_x_m, about("m", "field position along the lattice's rows")),
        "view_y": (("view_row",), field.view_y_m, about("m", "field position along the lattice's columns")),
        "pupil_x": (_LENSLET[1:] if is_square else _LENSLET, pupil_x_m, about("m", "lenslet centre")),
        "pupil_y": (("lenslet_row",), sensor.pupil_y_m, about("m", "lenslet centre")),
    }

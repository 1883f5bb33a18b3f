"""Results as NetCDF-4: wavefronts with their coordinates, units and origin, for xarray, MATLAB or Panoply."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import h5netcdf
import numpy as np
import xarray as xr

from app.bench.config import Bench, write_bench
from app.errors import InputError, RunError
from app.files import atomic_write
from app.results.view_quality import Variable, about, point_spread, structure, transfer
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor
from reconstruction.quality.image_quality import psf
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront, peak_to_valley, rms

_FRAME = "frame"
_VIEW = ("view_row", "view_column")
_LENSLET = ("lenslet_row", "lenslet_column")


def result_dataset(wavefront: Wavefront, *, with_psf: bool = False) -> xr.Dataset:
    """All that one wavefront says, with names and units as the README lists them; `with_psf` makes it much larger."""
    displacement = wavefront.displacement
    vectors = (*_LENSLET, "field_mode", "xy")
    variables: dict[str, Variable] = {
        **_wavefront_variables(wavefront.views, wavefront.sensor),
        "wavefront_sigma": ((*_VIEW, *_LENSLET), wavefront.sigma(), about("rad", "standard deviation of wavefront")),
        "displacement": (vectors, displacement.coefficients, about("px", "coefficients of the field modes")),
        "displacement_sigma": (vectors, np.sqrt(displacement.variance), about("px", "standard deviation")),
        "valid": (_LENSLET, displacement.valid, about("1", "whether the lenslet yields a slope")),
        "outcome": (_LENSLET, displacement.outcome, about("1", "0 converged, else why the lenslet was lost")),
        "residual_rms": (
            _LENSLET,
            displacement.residual_rms,
            about("1", "RMS misfit of the registered subimage over the contrast of the brightest one"),
        ),
        "range_used": (
            _LENSLET,
            displacement.range_used,
            about("1", "displacement of the field's edge over what the cell allows; above 1 it has left the cell"),
        ),
        "chi_square": (
            _LENSLET,
            displacement.chi_square,
            about("1", "reduced chi-square of the registered subimage; NaN where the camera's noise is not known"),
        ),
    }
    if isinstance(wavefront.solution, ModalSolution):
        modes = ("pupil_mode", "field_mode")
        solution = wavefront.solution
        variables["coefficients"] = (modes, solution.coefficients, about("rad", "e_pq"))
        variables["coefficients_sigma"] = (
            modes,
            solution.coefficients_sigma,
            about("rad", "standard deviation of e_pq"),
        )
        chi_square = about("1", "reduced chi-square of the slopes against the fit")
        variables["slope_chi_square"] = ((), np.array(solution.chi_square), chi_square)
    coordinates = _coordinates(wavefront.sensor, wavefront.field)
    read_outs = [transfer(wavefront), structure(wavefront)]
    for more, along in [*read_outs, point_spread(wavefront)] if with_psf else read_outs:
        variables |= more
        coordinates |= along
    return xr.Dataset({**variables, "xy": ("xy", ["x", "y"])}, coords=coordinates)


def truth_dataset(views: Floats, bench: Bench) -> xr.Dataset:
    """The true wavefront of every view (view_row, view_column, lenslet_row, lenslet_column), rad, as results are."""
    return xr.Dataset(_wavefront_variables(views, bench.sensor), coords=_coordinates(bench.sensor, bench.field))


def write_results(path: Path, dataset: xr.Dataset, *, bench: Bench, inputs: Mapping[str, str]) -> None:
    """Write a dataset with the bench, the software's version and the names of the inputs as attributes."""
    write_pieces(path, [dataset], bench=bench, inputs=inputs)


def open_results(path: Path | str) -> xr.Dataset:
    """Open a file of results; arrays are read when they are used. `InputError` if it holds none."""
    try:
        dataset = xr.open_dataset(path, engine="h5netcdf")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be opened as results: {error}") from error
    if "wavefront" not in dataset:
        dataset.close()
        raise InputError(f"{path}: holds no results: there is no variable wavefront in it")
    return dataset


def write_pieces(path: Path, pieces: Iterable[xr.Dataset], *, bench: Bench, inputs: Mapping[str, str]) -> None:
    """Write results of many frames, as `write_results` does, piece by piece along `frame`: one is in memory at a time.

    `InputError` when a piece has another shape than the first: the settings have changed between them.
    """
    with atomic_write(path) as temporary:
        for piece in pieces:
            if temporary.exists():
                _append(temporary, piece)
                continue
            origin = {"software": f"svwfs {version('svwfs')}", "bench": write_bench(bench), **inputs}
            piece.assign_attrs(title="Space-variant wavefront", **origin).to_netcdf(
                temporary, engine="h5netcdf", unlimited_dims=[_FRAME] if _FRAME in piece.dims else []
            )
        if not temporary.exists():
            raise RunError(f"{path}: there is nothing to write: no frame has a wavefront")


def _append(path: Path, piece: xr.Dataset) -> None:
    """Put more frames behind those that are in a file."""
    with h5netcdf.File(path, "r+") as file:
        first = file.dimensions[_FRAME].size
        sizes = {name: dimension.size for name, dimension in file.dimensions.items() if name != _FRAME}
        _require_alike(sizes, {name: size for name, size in piece.sizes.items() if name != _FRAME})
        file.resize_dimension(_FRAME, first + piece.sizes[_FRAME])
        for name, variable in piece.variables.items():
            if _FRAME in variable.dims:
                stored = file.variables[name]
                stored[first:] = variable.values.astype(stored.dtype)


def stack_frames(
    datasets: Sequence[xr.Dataset], frame_index: Sequence[int], time_s: Sequence[float], bias_age_s: Sequence[float]
) -> xr.Dataset:
    """Put the results of several frames after one another, along a new first dimension `frame`.

    `InputError` when they have different shapes.
    """
    for dataset in datasets:
        _require_alike(datasets[0].sizes, dataset.sizes)
    stacked = xr.concat(datasets, _FRAME, join="exact", combine_attrs="override", coords="minimal", compat="override")
    return stacked.assign_coords(
        frame_index=(_FRAME, list(frame_index), about("1", "the camera's count since start")),
        time=(_FRAME, list(time_s), about("s", "end of the exposure on the camera's clock")),
        bias_age=(_FRAME, list(bias_age_s), about("s", "age of the bias that refined the frame; NaN: not refined")),
    )


def _require_alike(sizes: Mapping[Hashable, int], others: Mapping[Hashable, int]) -> None:
    if dict(sizes) != dict(others):
        raise InputError("the settings changed between the frames: choose some that go together")


def _wavefront_variables(views: Floats, sensor: Sensor) -> dict[str, Variable]:
    strehl = psf(views, sensor, angle_rad=np.zeros(1))[..., 0, 0]
    return {
        "wavefront": ((*_VIEW, *_LENSLET), views, about("rad", "phase at the lenslet centres, piston removed")),
        "rms": (_VIEW, rms(views), about("rad", "RMS of each view's wavefront")),
        "strehl": (_VIEW, strehl, about("1", "Strehl ratio of each view's wavefront, tilt included")),
        "pv": (_VIEW, peak_to_valley(views), about("rad", "peak to valley of each view's wavefront")),
    }


def _coordinates(sensor: Sensor, field: Field) -> dict[str, Variable]:
    return {
        "view_x": (("view_column",), field.view_x_m, about("m", "field position along the lattice's rows")),
        "view_y": (("view_row",), field.view_y_m, about("m", "field position along the lattice's columns")),
        "pupil_x": (("lenslet_column",), sensor.pupil_x_m, about("m", "lenslet centre")),
        "pupil_y": (("lenslet_row",), sensor.pupil_y_m, about("m", "lenslet centre")),
    }

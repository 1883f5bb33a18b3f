"""Results as NetCDF-4: wavefronts with their coordinates, units and origin, for xarray, MATLAB or Panoply."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import xarray as xr

from app.config import Bench, write_bench
from app.files import appearing_whole
from reconstruction.geometry import Floats
from reconstruction.modal import ModalSolution
from reconstruction.wavefront import Wavefront, peak_to_valley, rms, strehl

_VIEW = ("view_row", "view_column")
_LENSLET = ("lenslet_row", "lenslet_column")


def result_dataset(wavefront: Wavefront, bench: Bench) -> xr.Dataset:
    """All that one wavefront says, with names and units as the README lists them."""
    displacement = wavefront.displacement
    vectors = (*_LENSLET, "field_mode", "xy")
    variables = {
        **_wavefront_variables(wavefront.views),
        "wavefront_sigma": ((*_VIEW, *_LENSLET), wavefront.sigma(), _about("rad", "standard deviation of wavefront")),
        "displacement": (vectors, displacement.coefficients, _about("px", "coefficients of the field modes")),
        "displacement_sigma": (vectors, np.sqrt(displacement.variance), _about("px", "standard deviation")),
        "valid": (_LENSLET, displacement.valid, _about("1", "whether the lenslet yields a slope")),
        "outcome": (_LENSLET, displacement.outcome, _about("1", "0 converged, else why the lenslet was lost")),
        "residual_rms": (
            _LENSLET,
            displacement.residual_rms,
            _about("1", "RMS misfit of the registered subimage over the contrast of the brightest one"),
        ),
        "chi_square": (
            _LENSLET,
            displacement.chi_square,
            _about("1", "reduced chi-square of the registered subimage; NaN where the camera's noise is not known"),
        ),
    }
    if isinstance(wavefront.solution, ModalSolution):
        modes = ("pupil_mode", "field_mode")
        solution = wavefront.solution
        variables["coefficients"] = (modes, solution.coefficients, _about("rad", "e_pq"))
        variables["coefficients_sigma"] = (
            modes,
            solution.coefficients_sigma,
            _about("rad", "standard deviation of e_pq"),
        )
        about = _about("1", "reduced chi-square of the slopes against the fit")
        variables["slope_chi_square"] = ((), np.array(solution.chi_square), about)
    return xr.Dataset({**variables, "xy": ("xy", ["x", "y"])}, coords=_coordinates(bench))


def truth_dataset(views: Floats, bench: Bench) -> xr.Dataset:
    """The true wavefront of every view (view_row, view_column, lenslet_row, lenslet_column), rad, as results are."""
    return xr.Dataset(_wavefront_variables(views), coords=_coordinates(bench))


def write_results(path: Path, dataset: xr.Dataset, *, bench: Bench, inputs: Mapping[str, str]) -> None:
    """Write a dataset with the bench, the software's version and the names of the inputs as attributes."""
    dataset = dataset.assign_attrs(
        title="Space-variant wavefront", software=f"svwfs {version('svwfs')}", bench=write_bench(bench), **inputs
    )
    with appearing_whole(path) as temporary:
        dataset.to_netcdf(temporary, engine="h5netcdf")


def stack_frames(datasets: Sequence[xr.Dataset], frame_index: Sequence[int], time_s: Sequence[float]) -> xr.Dataset:
    """Put the results of several frames after one another, along a new first dimension `frame`."""
    stacked = xr.concat(datasets, "frame", join="exact", combine_attrs="override", coords="minimal", compat="override")
    return stacked.assign_coords(
        frame_index=("frame", list(frame_index), _about("1", "the camera's count since start")),
        time=("frame", list(time_s), _about("s", "end of the exposure on the camera's clock")),
    )


def _wavefront_variables(views: Floats) -> dict[str, tuple[tuple[str, ...], Floats, dict[str, str]]]:
    return {
        "wavefront": ((*_VIEW, *_LENSLET), views, _about("rad", "phase at the lenslet centres, piston removed")),
        "rms": (_VIEW, rms(views), _about("rad", "RMS of each view's wavefront")),
        "strehl": (_VIEW, strehl(views), _about("1", "Strehl ratio of each view's wavefront, tilt included")),
        "pv": (_VIEW, peak_to_valley(views), _about("rad", "peak to valley of each view's wavefront")),
    }


def _coordinates(bench: Bench) -> dict[str, tuple[str, Floats, dict[str, str]]]:
    return {
        "view_x": ("view_column", bench.field.view_x_m, _about("m", "field position along the lattice's rows")),
        "view_y": ("view_row", bench.field.view_y_m, _about("m", "field position along the lattice's columns")),
        "pupil_x": ("lenslet_column", bench.sensor.pupil_x_m, _about("m", "lenslet centre")),
        "pupil_y": ("lenslet_row", bench.sensor.pupil_y_m, _about("m", "lenslet centre")),
    }


def _about(units: str, long_name: str) -> dict[str, str]:
    return {"units": units, "long_name": long_name}

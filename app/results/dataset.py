"""Results as a dataset: wavefronts with coordinates and units, image quality, what was assumed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from app.bench.config import Bench
from app.errors import SETTINGS_CHANGED, InputError
from app.measurement.measurement import Measurement
from app.results.point_spread import point_spread
from app.results.result_file import FRAME, LENSLET, PIECE, VIEW, Variable, about, require_alike, write_results
from reconstruction.arrays import Floats
from reconstruction.displacement import LensletStatus
from reconstruction.geometry import Field, Sensor
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.quality.image_quality import mtf, psf
from reconstruction.quality.isoplanatism import isoplanatism
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.registration.circulation import Circulation, measure_circulation
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront, peak_to_valley, rms

if TYPE_CHECKING:
    import xarray as xr

_RANGE = "displacement of the field's edge over what the cell allows; above 1 it has left the cell"
_CHI_SQUARE = "reduced chi-square of the registered subimage; NaN where the camera's noise is not known"
_MOST_LAYERS = 3  # layers of a sample; the same for all frames, so that they can be stacked


def transfer(wavefront: Wavefront) -> dict[str, Variable]:
    """Modulation transfer of every view, over the frequency along x and y."""
    found = mtf(wavefront.views, wavefront.sensor)
    variables: dict[str, Variable] = {}
    for axis, values, limit, frequency_per_rad in (
        ("x", found.along_x, found.limit_x, found.frequency_x_per_rad),
        ("y", found.along_y, found.limit_y, found.frequency_y_per_rad),
    ):
        along, name = f"frequency_{axis}", f"modulation transfer along {axis}"
        variables[f"mtf_{axis}"] = (*VIEW, along), values, about("1", name)
        variables[f"mtf_limit_{axis}"] = (*VIEW, along), limit, about("1", f"{name} without aberration")
        variables[along] = (along,), frequency_per_rad, about("1/rad", "cycles per radian of field angle")
    return variables


def structure(wavefront: Wavefront) -> dict[str, Variable]:
    """Differences of wavefronts over the field, over the separation of two positions."""
    found = isoplanatism(wavefront)
    error, without_tilt = np.array(found.error_rad), np.array(found.error_without_tilt_rad)
    at_views = about("rad", "RMS error of that one wavefront at each view")
    variables: dict[str, Variable] = {
        "global_error": ((), error, about("rad", "RMS error of one wavefront for the whole field")),
        "global_error_without_tilt": ((), without_tilt, about("rad", "the same, but for tip and tilt")),
        "global_error_view": (VIEW, found.view_error_rad, at_views),
        "separation": (("separation",), found.curve.separation_m, about("m", "of two positions in the field")),
    }
    for suffix, curve in (("", found.curve), ("_without_tilt", found.curve_without_tilt)):
        note = ", without tip and tilt" * bool(suffix)
        patch = f"separation where the difference reaches 1 rad{note}; inf: it does not"
        for name, values, long_name in (
            ("rms", curve.rms_rad, "RMS difference of two wavefronts"),
            ("least", curve.least_rad, "least of all pairs"),
            ("most", curve.most_rad, "most of all pairs"),
        ):
            variables[f"structure_{name}{suffix}"] = ("separation",), values, about("rad", long_name + note)
        variables[f"isoplanatic_patch{suffix}"] = (), np.array(curve.patch_m), about("m", patch)
    return variables


def result_dataset(wavefront: Wavefront, quality: Quality | None = None, *, with_psf: bool = False) -> xr.Dataset:
    """Return the results of a wavefront (docs/results.md); point-spread functions make them much larger."""
    import xarray as xr

    displacement, solution = wavefront.displacement, wavefront.solution
    vectors, modes = (*LENSLET, "field_mode", "xy"), ("pupil_mode", "field_mode")
    misfit = "RMS misfit of the registered subimage over the contrast of the brightest one"
    outcome = about("1", "0 converged, else why the lenslet was lost") | {
        "flag_values": np.array(list(LensletStatus), displacement.outcome.dtype),
        "flag_meanings": " ".join(each.name.lower() for each in LensletStatus),
    }
    variables: dict[str, Variable] = {
        **_wavefront_variables(wavefront.views, wavefront.sensor),
        "wavefront_sigma": ((*VIEW, *LENSLET), wavefront.sigma(), about("rad", "standard deviation of wavefront")),
        "displacement": (vectors, displacement.coefficients, about("px", "coefficients of the field modes")),
        "displacement_sigma": (vectors, np.sqrt(displacement.variance), about("px", "standard deviation")),
        "valid": (LENSLET, displacement.valid, about("1", "whether the lenslet has a slope")),
        "outcome": (LENSLET, displacement.outcome, outcome),
        "residual_rms": (LENSLET, displacement.residual_rms, about("1", misfit)),
        "range_used": (LENSLET, displacement.range_used, about("1", _RANGE)),
        "chi_square": (LENSLET, displacement.chi_square, about("1", _CHI_SQUARE)),
    }
    if (transmission := wavefront.transmission) is not None:
        brightness = about("1", "brightness of the source through the sample over that in the reference")
        variables |= {
            "transmission": ((*VIEW, *LENSLET), transmission[0], brightness),
            "transmission_sigma": ((*VIEW, *LENSLET), transmission[1], about("1", "standard deviation, noise only")),
        }
    if isinstance(solution, ModalSolution):
        sigma, chi_square = solution.coefficients_sigma, np.array(solution.chi_square)
        variables |= {
            "coefficients": (modes, solution.coefficients, about("rad", "coefficients e_pq of pupil and field modes")),
            "coefficients_sigma": (modes, sigma, about("rad", "standard deviation of e_pq")),
            "slope_chi_square": ((), chi_square, about("1", "reduced chi-square of the slopes against the fit")),
        }
    variables |= rotation_variables(wavefront) | sample_variables(wavefront.sample, wavefront.field)
    if quality is not None:  # as CF flags, one bit each
        name = "faults that make the wavefront doubtful; 0 if none was found"
        bits = np.array([int(fault) for fault in Fault], np.int32)
        meanings = " ".join(fault.name.lower() for fault in Fault if fault.name)
        flags = {**about("1", name), "flag_masks": bits, "flag_meanings": meanings}
        variables["quality"] = (), np.array(int(quality.faults), np.int32), flags
    variables |= transfer(wavefront) | structure(wavefront)
    if with_psf:
        variables |= point_spread(wavefront)
    coordinates = _coordinates(wavefront.sensor, wavefront.field)
    attributes = propagation(wavefront.field)
    return xr.Dataset({**variables, "xy": ("xy", ["x", "y"])}, coords=coordinates, attrs=attributes)


def truth_dataset(views: Floats, light: Floats, bench: Bench) -> xr.Dataset:
    """Results of a true wavefront, rad, (view_row, view_column, lenslet_row, lenslet_column), and relative light."""
    import xarray as xr

    variables = {
        **_wavefront_variables(views, bench.sensor),
        "light": ((*VIEW, *LENSLET), light, about("1", "intensity at the lenslet centres over that without sample")),
    }
    return xr.Dataset(variables, coords=_coordinates(bench.sensor, bench.field), attrs=propagation(bench.field))


def results_in_pieces(
    frames: Iterable[tuple[Measurement, Mapping[str, Variable]]],
    results_of: Callable[[Wavefront, Quality], xr.Dataset] = result_dataset,
) -> Iterator[xr.Dataset]:
    """Stack the results of frames, with more variables of each, in pieces that fit in memory.

    Frames without a wavefront are left out; the coordinate `recording_index` has the index in the recording.
    """
    made = (  # a wavefront holds megabytes of its solution: none is kept
        (
            results.assign(more) if more else results,  # assign copies every variable
            (one.frame.index, one.frame.camera_time_s, one.assumed.refinement.age_s, one.index),
        )
        for one, more in frames
        if one.wavefront is not None
        for results in [results_of(one.wavefront, one.quality)]
    )
    while piece := list(islice(made, PIECE)):
        datasets, facts = zip(*piece, strict=True)
        *of_frames, indices = zip(*facts, strict=True)
        index = about("1", "the frame's index in the recording")
        yield stack_frames(datasets, *of_frames).assign_coords(recording_index=(FRAME, list(indices), index))


def stack_frames(
    datasets: Sequence[xr.Dataset], frame_index: Sequence[int], time_s: Sequence[float], bias_age_s: Sequence[float]
) -> xr.Dataset:
    """Stack results along a new first dimension `frame`; `InputError` if their settings differ."""
    import xarray as xr

    first = datasets[0]
    for dataset in datasets:
        require_alike(first.sizes, dataset.sizes)
        is_alike = set(first.data_vars) == set(dataset.data_vars)
        if not is_alike or any(not index.equals(dataset.indexes[name]) for name, index in first.indexes.items()):
            raise InputError(SETTINGS_CHANGED)
    stacked = {  # xarray.concat took a third of the time of a result, because it aligns every variable
        name: ((FRAME, *variable.dims), np.stack([each.variables[name].values for each in datasets]), variable.attrs)
        for name, variable in first.data_vars.items()
    }
    return xr.Dataset(stacked, coords=first.coords, attrs=first.attrs).assign_coords(
        frame_index=(FRAME, list(frame_index), about("1", "the camera's count since start")),
        time=(FRAME, list(time_s), about("s", "end of the exposure on the camera's clock")),
        bias_age=(FRAME, list(bias_age_s), about("s", "age of the bias that refined the frame; NaN: not refined")),
    )


def _wavefront_variables(views: Floats, sensor: Sensor) -> dict[str, Variable]:
    """Describe wavefronts, rad, (view_row, view_column, lenslet_row, lenslet_column)."""
    strehl = psf(views, sensor, angle_rad=np.zeros(1))[..., 0, 0]
    return {
        "wavefront": ((*VIEW, *LENSLET), views, about("rad", "phase at the lenslet centres, piston removed")),
        "rms": (VIEW, rms(views), about("rad", "RMS of each view's wavefront")),
        "strehl": (VIEW, strehl, about("1", "Strehl ratio of each view's wavefront, tilt included")),
        "pv": (VIEW, peak_to_valley(views), about("rad", "peak to valley of each view's wavefront")),
    }


def _coordinates(sensor: Sensor, field: Field) -> dict[str, Variable]:
    is_square = sensor.arrangement == "square"
    pupil_x_m = sensor.pupil_x_m if is_square else sensor.lenslet_centers_m[..., 0]
    return {
        "view_x": (("view_column",), field.view_x_m, about("m", "field position along the lattice's rows")),
        "view_y": (("view_row",), field.view_y_m, about("m", "field position along the lattice's columns")),
        "pupil_x": (LENSLET[1:] if is_square else LENSLET, pupil_x_m, about("m", "lenslet centre")),
        "pupil_y": (("lenslet_row",), sensor.pupil_y_m, about("m", "lenslet centre")),
    }


def sample_variables(sample: AssumedSample, of: Field) -> dict[str, Variable]:
    """Return number and distances of the assumed layers; distances are NaN beyond their number."""
    distance_m, sigma_m = np.full((2, _MOST_LAYERS), np.nan)
    count = len(sample.ratios)
    distance_m[:count] = -np.array(sample.ratios) * of.collimator_focal_length_m
    sigma_m[:count] = sample.sigma * of.collimator_focal_length_m
    assumed = "layers that were assumed to make up the sample; 0: any wavefront was allowed; 3: one with depth"
    towards = "distance of each assumed layer from the lenslets, positive towards the source"
    return {
        "assumed_layers": ((), np.array(count, np.int8), about("1", assumed)),
        "layer_distance": (("layer",), distance_m, about("m", towards)),
        "layer_distance_sigma": (("layer",), sigma_m, about("m", "standard deviation of layer_distance")),
    }


def propagation(field: Field) -> dict[str, str]:
    """Return the attribute that says how light goes from sample to lenslets."""
    return {"propagation_of_light": "neglected" if field.neglect_propagation else "from sample to lenslets"}


def rotation_of(wavefront: Wavefront) -> Circulation | None:
    """Measure the rotation of the subimages; None with `registration.rotation = false`."""
    return measure_circulation(wavefront.displacement, wavefront.field.half_width_px(wavefront.sensor))


def rotation_variables(wavefront: Wavefront) -> dict[str, Variable]:
    """Return the rotation of the subimages as variables; none with `registration.rotation = false`."""
    found = rotation_of(wavefront)
    if found is None:
        return {}
    rotation = "rotation of the subimage, from +x to +y; NaN if lost or not shown by the source"
    chi_square = "reduced chi-square of the circulation of a typical lenslet; 0 if not shown by the source"
    return {
        "rotation": (LENSLET, found.rotation_rad, about("rad", rotation)),
        "rotation_sigma": (LENSLET, found.rotation_sigma_rad, about("rad", "standard deviation, noise only")),
        "rotation_significance": ((), np.array(found.significance), about("1", "mean rotation over its error")),
        "circulation_chi_square": ((), np.array(found.chi_square), about("1", chi_square)),
        "contradicts_layers": ((), np.array(found.contradicts_layers), about("1", "whether subimages rotate")),
    }


def write_shown(path: Path, shown: Wavefront, bench: Bench, *, options: str) -> None:
    """Write a wavefront as it is shown, as NetCDF; the attribute `display` names the options."""
    bench = replace(bench, field=shown.field, sensor=shown.sensor)  # the display may have chosen other views
    write_results(path, result_dataset(shown), bench=bench, inputs={"display": options or "as measured"})

"""Names, dimensions, units and values of result files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5netcdf
import numpy as np
import pytest
import xarray as xr
from support.optics import FIELD, SmallBench
from support.paths import DOCS, FOREIGN_FRAMES

from app.bench.config import load_bench, parse_bench
from app.errors import InputError
from app.results.dataset import result_dataset, sample_variables, stack_frames
from app.results.result_file import write_pieces, write_results
from reconstruction.displacement import Transmission, diagonal_covariance
from reconstruction.layers.layered_wavefront import AssumedSample
from reconstruction.wavefront import Wavefront

BENCH = load_bench(
    FOREIGN_FRAMES / "bench.toml",
    ("sensor.lenslet_rows=7", "sensor.lenslet_columns=9", "registration.warp=affine", "reconstruction.pupil_modes=21"),
)


@pytest.fixture(scope="module")
def dataset(small_bench: SmallBench) -> xr.Dataset:
    frame = small_bench.reference.copy()
    x, y = small_bench.lattice.lenslet_centers_px(7, 9)[2, 5]
    frame[int(y - 14) : int(y + 16), int(x - 14) : int(x + 16)] = 0
    return result_dataset(small_bench.reconstructor()(frame))


def test_results_have_documented_names_dimensions_and_units(dataset: xr.Dataset, tmp_path: Path) -> None:
    write_results(tmp_path / "r.nc", dataset, bench=BENCH, inputs={"frame": "f.tif", "reference": "r.tif"})
    with xr.open_dataset(tmp_path / "r.nc") as read:
        read.load()
    dimensions = {
        "wavefront": ("view_row", "view_column", "lenslet_row", "lenslet_column"),
        "displacement": ("lenslet_row", "lenslet_column", "field_mode", "xy"),
        "valid": ("lenslet_row", "lenslet_column"),
        "residual_rms": ("lenslet_row", "lenslet_column"),
        "coefficients": ("pupil_mode", "field_mode"),
        "coefficients_sigma": ("pupil_mode", "field_mode"),
        "wavefront_sigma": ("view_row", "view_column", "lenslet_row", "lenslet_column"),
        "chi_square": ("lenslet_row", "lenslet_column"),
        "mtf_x": ("view_row", "view_column", "frequency_x"),
        "mtf_limit_y": ("view_row", "view_column", "frequency_y"),
        "structure_rms": ("separation",),
        "global_error_view": ("view_row", "view_column"),
        "isoplanatic_patch": (),
        "slope_chi_square": (),
        "assumed_layers": (),
        "layer_distance": ("layer",),
    }
    for name, names in dimensions.items():
        assert read[name].dims == names
    outcome = read["outcome"].attrs
    assert outcome["flag_meanings"].split()[outcome["flag_values"].tolist().index(1)] == "dark"
    assert dict(read.sizes) == {
        "view_row": 3,
        "view_column": 3,
        "lenslet_row": 7,
        "lenslet_column": 9,
        "field_mode": 3,
        "xy": 2,
        "pupil_mode": 21,
        "frequency_x": 55,
        "frequency_y": 43,
        "separation": 8,
        "layer": 3,
    }
    units = {"wavefront": "rad", "coefficients": "rad", "displacement": "px", "view_x": "m", "pupil_y": "m"}
    assert {name: read[name].attrs["units"] for name in units} == units
    np.testing.assert_allclose(read["view_x"], [-0.5e-3, 0, 0.5e-3])
    np.testing.assert_allclose(read["pupil_x"], np.arange(-4, 5) * 0.5e-3)
    np.testing.assert_allclose(read["pupil_y"], np.arange(-3, 4) * 0.5e-3)
    assert parse_bench(read.attrs["bench"], "attribute") == BENCH
    assert read.attrs["software"].startswith("svwfs ")
    assert (read.attrs["frame"], read.attrs["reference"]) == ("f.tif", "r.tif")
    xr.testing.assert_identical(read["wavefront"].drop_attrs(), dataset["wavefront"].drop_attrs())
    assert not list(tmp_path.glob(".*"))


def test_axes_and_errors_are_the_wavefronts_own(small_bench: SmallBench) -> None:
    """More columns of views than rows, displacements with variances of 4 and 9 px^2 along x and y, a grey sample."""
    wide = replace(FIELD, view_rows=1, view_columns=5, view_spacing_m=2e-4)
    measured = small_bench.reconstructor()(small_bench.reference)
    displacement = measured.displacement
    known = np.broadcast_to([4.0, 9.0], displacement.coefficients.shape)
    grey, noise = (np.zeros((*displacement.valid.shape, *shape)) for shape in ((6,), (6, 6)))
    grey[..., 0], noise[..., 0, 0] = 0.7, 0.02**2
    light = Transmission(grey, noise)
    displacement = replace(displacement, covariance_source=diagonal_covariance(known), transmission_source=light)
    dataset = result_dataset(Wavefront.of(measured.sensor, wide, displacement, measured.solution))
    assert dataset["view_x"].dims == ("view_column",)
    np.testing.assert_allclose(dataset["view_x"], np.arange(-2, 3) * wide.view_spacing_m)
    np.testing.assert_allclose(dataset["view_y"], [0])
    sigma_px = dataset["displacement_sigma"].transpose("xy", ...).to_numpy()
    np.testing.assert_allclose(sigma_px[0], 2)
    np.testing.assert_allclose(sigma_px[1], 3)
    np.testing.assert_allclose(dataset["transmission"], 0.7)
    np.testing.assert_allclose(dataset["transmission_sigma"], 0.02)


def test_distance_of_an_assumed_layer_and_its_error_are_lengths() -> None:
    """A collimator of 200 mm: the ratio -0.6 +- 0.01 is a layer 120 +- 2 mm in front of the lenslets."""
    variables = sample_variables(AssumedSample((-0.6,), np.array([[0.01**2]])), FIELD)
    assert variables["assumed_layers"][1] == 1
    for name, distance_m in (("layer_distance", 0.12), ("layer_distance_sigma", 0.002)):
        np.testing.assert_allclose(variables[name][1], [distance_m, np.nan, np.nan])


def test_documentation_lists_every_variable(dataset: xr.Dataset) -> None:
    text = (DOCS / "results.md").read_text("utf-8")
    missing = [name for name in dataset.data_vars if f"`{str(name).removesuffix('_without_tilt')}`" not in text]
    assert not missing


def test_lost_lenslet_is_invalid_and_nan(dataset: xr.Dataset) -> None:
    valid = dataset["valid"].to_numpy()
    assert not valid[2, 5]
    assert np.count_nonzero(~valid) == 1
    assert np.isnan(dataset["displacement"].to_numpy()[2, 5]).all()
    assert np.isnan(dataset["residual_rms"].to_numpy()[2, 5])


def test_frames_stack_along_a_first_dimension(dataset: xr.Dataset) -> None:
    stacked = stack_frames([dataset, dataset * 2], [4, 7], [0.1, 0.2], [np.nan, 0.5])
    assert stacked["wavefront"].dims[0] == "frame"
    np.testing.assert_array_equal(stacked["frame_index"], [4, 7])
    np.testing.assert_allclose(stacked["wavefront"][1], 2 * dataset["wavefront"])
    assert stacked["view_x"].dims == ("view_column",)


@pytest.mark.parametrize("change", ["separation", "coefficients"])
def test_frames_with_other_settings_do_not_stack(dataset: xr.Dataset, change: str) -> None:
    """Other positions, or another method, though the sizes are the same."""
    other = (
        dataset.drop_vars(change) if change == "coefficients" else dataset.assign_coords({change: dataset[change] * 2})
    )
    with pytest.raises(InputError, match="the settings changed between these frames"):
        stack_frames([dataset, other], [0, 1], [0.0, 0.1], [0.0, 0.0])


@pytest.mark.slow
@pytest.mark.long
def test_pieces_write_the_same_file_as_the_whole(dataset: xr.Dataset, tmp_path: Path) -> None:
    frames = [
        dataset.assign(rms=dataset["rms"] * factor, valid=dataset["valid"] ^ bool(factor % 2)) for factor in range(5)
    ]
    whole = stack_frames(frames, [0, 1, 3, 4, 9], [0.0, 0.1, 0.3, 0.4, 0.9], [0.0] * 5)
    write_results(tmp_path / "whole.nc", whole, bench=BENCH, inputs={"recording": "r"})
    pieces = (whole.isel(frame=part) for part in (slice(0, 2), slice(2, 3), slice(3, 5)))
    write_pieces(tmp_path / "pieces.nc", pieces, bench=BENCH, inputs={"recording": "r"})
    with xr.open_dataset(tmp_path / "whole.nc") as one, xr.open_dataset(tmp_path / "pieces.nc") as other:
        xr.testing.assert_identical(one, other)
        assert other.sizes["frame"] == 5
        xr.testing.assert_identical(other["rms"].drop_attrs(), whole["rms"].drop_attrs())
        xr.testing.assert_identical(other["valid"].drop_attrs(), whole["valid"].drop_attrs())


def test_pieces_of_another_shape_leave_no_file(dataset: xr.Dataset, tmp_path: Path) -> None:
    whole = stack_frames([dataset], [0], [0.0], [0.0])
    fewer = whole.isel(pupil_mode=slice(0, 10))
    with pytest.raises(InputError, match="the settings changed"):
        write_pieces(tmp_path / "r.nc", [whole, fewer], bench=BENCH, inputs={})
    assert not list(tmp_path.iterdir())


def test_flat_wavefront_is_diffraction_limited(small_bench: SmallBench) -> None:
    flat = result_dataset(small_bench.reconstructor()(small_bench.reference), with_psf=True)
    np.testing.assert_allclose(flat["strehl"], 1, atol=1e-4)
    np.testing.assert_allclose(flat["mtf_x"], flat["mtf_limit_x"], atol=1e-3)
    triangle = 1 - flat["frequency_x"] * BENCH.sensor.wavelength_m / (9 * BENCH.sensor.lenslet_pitch_m)
    np.testing.assert_allclose(flat["mtf_x"][1, 1], triangle, atol=1e-3)
    assert np.isinf(flat["isoplanatic_patch"])
    assert float(flat["global_error"]) < 1e-3
    brightest = flat["psf"][1, 1].argmax(["angle_y", "angle_x"])
    assert abs(float(flat["angle_x"][brightest["angle_x"]])) < 1e-9
    assert float(flat["psf"][1, 1].max()) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("pieces", [1, 2])
def test_only_a_file_of_several_pieces_has_an_unlimited_dimension(
    dataset: xr.Dataset, tmp_path: Path, pieces: int
) -> None:
    piece = stack_frames([dataset] * 2, [0, 1], [0.0, 0.1], [0.0, 0.0])
    write_pieces(tmp_path / "r.nc", [piece] * pieces, bench=BENCH, inputs={})
    with h5netcdf.File(tmp_path / "r.nc", "r") as file:
        assert file.dimensions["frame"].isunlimited() == (pieces > 1)
        assert file.dimensions["frame"].size == 2 * pieces

"""The measurement matrix on disk against the streamed forward model."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from support.optics import FIELD, sensor_of

from reconstruction.arrays import PointField
from reconstruction.geometry import Lattice
from simulated_devices.optics import source
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.measurement_matrix import MeasurementMatrix
from simulated_devices.optics.phase_screen import PhaseScreen, smooth_screen
from simulated_devices.optics.screen_light import RayMap, ScreenLight
from simulated_devices.optics.source import SourcePoints
from simulated_devices.sample import point_field
from simulated_devices.settings import Source

SENSOR = sensor_of(4, 5)
LATTICE = Lattice(center_x_px=81.3, center_y_px=68.9, pitch_px=31.25, rotation_rad=0.03)
N = 13  # an object step of 0.1 mm, so that stars 0.5 mm apart lie on the grid
GRID = source.source_points("square", Source(), object_samples=N)
POINT_STARS = Source(pinhole_diameter_m=0.0)


@pytest.fixture(scope="module")
def model() -> ForwardModel:
    return ForwardModel(
        SENSOR, LATTICE, FIELD, shape=(140, 170), pupil_samples=12, pixel_fill_factor=1.0, border_lenslets=0
    )


@pytest.fixture(scope="module")
def field(model: ForwardModel) -> PointField:
    generator = np.random.default_rng(3)
    samples = smooth_screen(generator, samples=181, sample_spacing_m=25e-6, correlation_length_m=0.8e-3)
    ray_map = RayMap.near_pupil(distance_m=0.195, collimator_focal_length_m=0.2)
    light = ScreenLight(PhaseScreen(samples * (6.0 / samples.std()), 25e-6), None, ray_map)
    return point_field(light, model.sample_x_m, model.sample_y_m)


def write(path: Path, model: ForwardModel, field: PointField | None) -> MeasurementMatrix:
    return MeasurementMatrix.write(path, model, GRID.position_m, field)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory, model: ForwardModel, field: PointField) -> MeasurementMatrix:
    return write(tmp_path_factory.mktemp("matrix") / "behind.zarr", model, field)


def objects() -> dict[str, np.ndarray]:
    stars = source.stars(POINT_STARS)
    on_grid = np.zeros(N * N)
    for position_m, area_m2 in zip(stars.position_m, stars.area_m2, strict=True):
        on_grid[np.abs(GRID.position_m - position_m).max(axis=1) < 1e-9] = area_m2
    assert (on_grid > 0).sum() == 9
    random = np.random.default_rng(8).uniform(size=N * N) * 1e-9
    return {"square": GRID.area_m2, "stars": on_grid, "random": random}


def assert_same(matrix: MeasurementMatrix, model: ForwardModel, field: PointField | None) -> None:
    for name, area_m2 in objects().items():
        points = SourcePoints(position_m=GRID.position_m, area_m2=area_m2)
        streamed = model.irradiance(source.stars(POINT_STARS) if name == "stars" else points, field)
        image = matrix.multiply(area_m2)
        assert image.dtype == np.float32
        np.testing.assert_allclose(image, streamed, rtol=0, atol=1e-5 * streamed.max(), err_msg=name)


def test_matrix_times_object_is_the_image_of_the_forward_model(
    tmp_path: Path, model: ForwardModel, field: PointField, stored: MeasurementMatrix
) -> None:
    assert_same(stored, model, field)
    assert_same(write(tmp_path / "reference.zarr", model, None), model, None)


def test_column_is_the_image_of_its_point(model: ForwardModel, field: PointField, stored: MeasurementMatrix) -> None:
    for point in (0, 20, N * N - 1):
        alone = SourcePoints(position_m=GRID.position_m[point : point + 1], area_m2=np.ones(1))
        image = model.irradiance(alone, field)
        np.testing.assert_allclose(stored.block(point, point + 1)[0], image, rtol=0, atol=1e-5 * image.max())


def test_written_matrix_opens_unchanged(stored: MeasurementMatrix) -> None:
    again = MeasurementMatrix(stored.path)
    assert again.shape == (N * N, 140, 170)
    np.testing.assert_array_equal(again.position_m, GRID.position_m)
    np.testing.assert_array_equal(again.multiply(GRID.area_m2), stored.multiply(GRID.area_m2))


def test_existing_folder_is_left_alone(tmp_path: Path, model: ForwardModel) -> None:
    with pytest.raises(ValueError, match="exists: delete it, or choose another name"):
        write(tmp_path, model, None)


def test_part_of_a_matrix_is_refused(tmp_path: Path, stored: MeasurementMatrix) -> None:
    lacking = Path(shutil.copytree(stored.path, tmp_path / "lacking"))
    min(item for item in (lacking / "c").rglob("*") if item.is_file()).unlink()
    with pytest.raises(ValueError, match=r"lacking is incomplete: 10 of 11 blocks are there"):
        MeasurementMatrix(lacking)
    (lacking / "zarr.json").write_text("{")
    for path in (lacking, tmp_path / "absent", tmp_path):
        with pytest.raises(ValueError, match="is not a measurement matrix"):
            MeasurementMatrix(path)

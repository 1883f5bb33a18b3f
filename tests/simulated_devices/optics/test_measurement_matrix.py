"""The measurement matrix on disk against the streamed forward model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.optics import FIELD, sensor_of
from support.windows import open_files_stay

from reconstruction.arrays import PointField
from reconstruction.geometry import Lattice
from simulated_devices.optics import source
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.optics.measurement_matrix import multiply, write_matrix
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


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory, model: ForwardModel, field: PointField) -> Path:
    path = tmp_path_factory.mktemp("matrix") / "behind.npy"
    write_matrix(path, model, GRID.position_m, field)
    return path


def objects() -> dict[str, np.ndarray]:
    stars = source.stars(POINT_STARS)
    on_grid = np.zeros(N * N)
    for position_m, area_m2 in zip(stars.position_m, stars.area_m2, strict=True):
        on_grid[np.abs(GRID.position_m - position_m).max(axis=1) < 1e-9] = area_m2
    assert (on_grid > 0).sum() == 9
    random = np.random.default_rng(8).uniform(size=N * N) * 1e-9
    return {"square": GRID.area_m2, "stars": on_grid, "random": random}


def assert_same(matrix: Path, model: ForwardModel, field: PointField | None) -> None:
    for name, area_m2 in objects().items():
        points = SourcePoints(position_m=GRID.position_m, area_m2=area_m2)
        streamed = model.irradiance(source.stars(POINT_STARS) if name == "stars" else points, field)
        image = multiply(matrix, area_m2)
        assert image.dtype == np.float32
        np.testing.assert_allclose(image, streamed, rtol=0, atol=1e-5 * streamed.max(), err_msg=name)


def test_matrix_times_object_is_the_image_of_the_forward_model(
    tmp_path: Path, model: ForwardModel, field: PointField, stored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_same(stored, model, field)
    open_files_stay(monkeypatch)
    write_matrix(tmp_path / "reference.npy", model, GRID.position_m)
    assert_same(tmp_path / "reference.npy", model, None)


def test_column_is_the_image_of_its_point(model: ForwardModel, field: PointField, stored: Path) -> None:
    for point in (0, 20, N * N - 1):
        alone = SourcePoints(position_m=GRID.position_m[point : point + 1], area_m2=np.ones(1))
        image = model.irradiance(alone, field)
        np.testing.assert_allclose(np.load(stored, mmap_mode="r")[point], image, rtol=0, atol=1e-5 * image.max())


def test_existing_file_is_left_alone(model: ForwardModel, stored: Path) -> None:
    with pytest.raises(ValueError, match="exists: delete it, or choose another name"):
        write_matrix(stored, model, GRID.position_m)


def test_failure_leaves_no_part(tmp_path: Path, model: ForwardModel, monkeypatch: pytest.MonkeyPatch) -> None:
    open_files_stay(monkeypatch)

    def fail(_x_m: float, _y_m: float) -> NDArray[np.complex64]:
        raise RuntimeError("no light")

    with pytest.raises(RuntimeError, match="no light"):
        write_matrix(tmp_path / "matrix.npy", model, GRID.position_m, fail)
    assert not list(tmp_path.iterdir())


def test_object_of_another_size_is_refused(stored: Path) -> None:
    with pytest.raises(ValueError, match=f"for each of the {N * N} points"):
        multiply(stored, np.ones(3))

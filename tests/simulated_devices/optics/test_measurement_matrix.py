"""The measurement matrix against the streamed forward model, on disk and off it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr

from reconstruction.geometry import Field, Lattice, Sensor
from simulated_devices.optics import source
from simulated_devices.optics.forward_model import ForwardModel, PointPhase
from simulated_devices.optics.measurement_matrix import MeasurementMatrix, StoredMatrix, StreamedMatrix
from simulated_devices.optics.phase_screen import PhaseScreen, smooth_screen
from simulated_devices.optics.ray_map import RayMap
from simulated_devices.optics.source import SourcePoints
from simulated_devices.settings import Source

SENSOR = Sensor(
    lenslet_rows=4,
    lenslet_columns=5,
    lenslet_pitch_m=500e-6,
    lenslet_focal_length_m=46.7e-3,
    wavelength_m=462e-9,
    pixel_pitch_m=16e-6,
)
LATTICE = Lattice(center_x_px=81.3, center_y_px=68.9, pitch_px=31.25, rotation_rad=0.03)
FIELD = Field(collimator_focal_length_m=0.2, half_width_m=0.6e-3)
N = 13  # an object step of 0.1 mm, so that stars 0.5 mm apart lie on the grid
GRID = source.square(Source(), object_samples=N)
POINT_STARS = Source(pinhole_diameter_m=0.0)


@pytest.fixture(scope="module")
def model() -> ForwardModel:
    return ForwardModel(SENSOR, LATTICE, FIELD, rows=140, columns=170, pupil_samples=12)


@pytest.fixture(scope="module")
def phase(model: ForwardModel) -> PointPhase:
    generator = np.random.default_rng(3)
    samples = smooth_screen(generator, samples=181, sample_spacing_m=25e-6, correlation_length_m=0.8e-3)
    ray_map = RayMap.near_pupil(distance_m=0.195, collimator_focal_length_m=0.2)
    return model.screen_phase(PhaseScreen(samples * (6.0 / samples.std()), 25e-6), ray_map)


def write(path: Path, model: ForwardModel, phase: PointPhase | None) -> StoredMatrix:
    return StoredMatrix.write(path, StreamedMatrix(model, GRID.position_m, phase))


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory, model: ForwardModel, phase: PointPhase) -> StoredMatrix:
    return write(tmp_path_factory.mktemp("matrix") / "behind.zarr", model, phase)


def objects() -> dict[str, np.ndarray]:
    stars = source.stars(POINT_STARS)
    on_grid = np.zeros(N * N)
    for position_m, area_m2 in zip(stars.position_m, stars.area_m2, strict=True):
        on_grid[np.abs(GRID.position_m - position_m).max(axis=1) < 1e-9] = area_m2
    assert (on_grid > 0).sum() == 9
    random = np.random.default_rng(8).uniform(size=N * N) * 1e-9
    return {"square": GRID.area_m2, "stars": on_grid, "random": random}


def assert_same(matrix: MeasurementMatrix, model: ForwardModel, phase: PointPhase | None) -> None:
    for name, area_m2 in objects().items():
        points = SourcePoints(position_m=GRID.position_m, area_m2=area_m2)
        streamed = model.irradiance(source.stars(POINT_STARS) if name == "stars" else points, phase)
        image = matrix.multiply(area_m2)
        assert image.dtype == np.float32
        np.testing.assert_allclose(image, streamed, rtol=0, atol=1e-5 * streamed.max(), err_msg=name)


def test_matrix_times_object_is_the_forward_models_image_with_and_without_a_screen(
    tmp_path: Path, model: ForwardModel, phase: PointPhase, stored: StoredMatrix
) -> None:
    assert_same(stored, model, phase)
    assert_same(StreamedMatrix(model, GRID.position_m, phase), model, phase)
    assert_same(write(tmp_path / "reference.zarr", model, None), model, None)


def test_a_column_is_the_image_of_its_own_point(model: ForwardModel, phase: PointPhase, stored: StoredMatrix) -> None:
    for point in (0, 20, N * N - 1):
        alone = SourcePoints(position_m=GRID.position_m[point : point + 1], area_m2=np.ones(1))
        image = model.irradiance(alone, phase)
        np.testing.assert_allclose(stored.block(point, point + 1)[0], image, rtol=0, atol=1e-5 * image.max())


def test_a_matrix_is_found_again_as_it_was_written(stored: StoredMatrix) -> None:
    again = StoredMatrix(stored.path)
    assert again.shape == (N * N, 140, 170)
    np.testing.assert_array_equal(again.position_m, GRID.position_m)
    np.testing.assert_array_equal(again.multiply(GRID.area_m2), stored.multiply(GRID.area_m2))


def test_a_new_matrix_takes_the_place_of_an_old_one_but_of_nothing_else(
    tmp_path: Path, model: ForwardModel, phase: PointPhase
) -> None:
    path = tmp_path / "a.zarr"
    write(path, model, phase)
    new = write(path, model, None)
    assert_same(new, model, None)
    assert [item.name for item in tmp_path.iterdir()] == ["a.zarr"]
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("dear")
    with pytest.raises(ValueError, match="is no measurement matrix; it is left alone"):
        write(tmp_path / "letters", model, None)
    assert (tmp_path / "letters" / "dear.txt").exists()


def test_progress_is_heard_and_what_it_raises_leaves_nothing(tmp_path: Path, model: ForwardModel) -> None:
    matrix = StreamedMatrix(model, GRID.position_m)
    heard: list[float] = []

    def progress(part: float) -> None:
        heard.append(part)
        if part > 0.5:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        StoredMatrix.write(tmp_path / "a.zarr", matrix, progress=progress)
    assert heard == sorted(heard)
    assert 0 < heard[0] < 0.2
    assert 0.5 < heard[-1] < 0.7
    assert not list(tmp_path.iterdir())
    heard.clear()
    matrix.multiply(GRID.area_m2, progress=heard.append)
    assert heard[-1] == 1


def chunk_files(path: Path) -> list[Path]:
    return sorted(item for item in (path / "c").rglob("*") if item.is_file())


def test_a_damaged_matrix_is_refused(tmp_path: Path, stored: StoredMatrix) -> None:
    def copy(name: str) -> Path:
        return Path(shutil.copytree(stored.path, tmp_path / name))

    lacking = copy("lacking")
    chunk_files(lacking)[2].unlink()
    with pytest.raises(ValueError, match=r"lacking is incomplete: 10 of 11 blocks are there"):
        StoredMatrix(lacking)
    flipped = copy("flipped")
    chunk = chunk_files(flipped)[1]
    content = bytearray(chunk.read_bytes())
    content[1000] ^= 4
    chunk.write_bytes(content)
    with pytest.raises(ValueError, match="flipped is damaged"):
        StoredMatrix(flipped).multiply(GRID.area_m2)
    shortened = copy("shortened")
    chunk = chunk_files(shortened)[1]
    chunk.write_bytes(chunk.read_bytes()[:1000])
    with pytest.raises(ValueError, match="shortened is damaged"):
        StoredMatrix(shortened).multiply(GRID.area_m2)
    headless = copy("headless")
    (headless / "zarr.json").write_text("{")
    for path in (headless, tmp_path / "absent", tmp_path):
        with pytest.raises(ValueError, match="is not a measurement matrix"):
            StoredMatrix(path)


def test_an_object_of_the_wrong_size_is_refused(stored: StoredMatrix) -> None:
    with pytest.raises(ValueError, match="for each of the 169 points"):
        stored.multiply(np.ones(168))
    with pytest.raises(ValueError, match="must be finite"):
        stored.multiply(np.full(169, np.nan))


def test_a_dark_block_is_kept_as_one_that_is_there(tmp_path: Path) -> None:
    beside = Lattice(center_x_px=900.0, center_y_px=68.9, pitch_px=31.25)
    dark = ForwardModel(SENSOR, beside, FIELD, rows=140, columns=170, pupil_samples=12)
    assert not write(tmp_path / "dark.zarr", dark, None).multiply(GRID.area_m2).any()


def test_a_block_that_has_gone_is_a_fault_and_not_darkness(
    tmp_path: Path, model: ForwardModel, phase: PointPhase
) -> None:
    matrix = write(tmp_path / "a.zarr", model, phase)
    next(path for path in (tmp_path / "a.zarr" / "c").rglob("*") if path.is_file()).unlink()
    with pytest.raises(ValueError, match="is damaged: a block has gone"):
        matrix.multiply(GRID.area_m2)


def test_a_zarr_store_of_something_else_is_left_alone(tmp_path: Path, model: ForwardModel) -> None:
    zarr.create_array(str(tmp_path / "a.zarr"), shape=(3,), dtype="f4")
    with pytest.raises(ValueError, match="left alone"):
        write(tmp_path / "a.zarr", model, None)
    assert zarr.open_array(str(tmp_path / "a.zarr"), mode="r").shape == (3,)

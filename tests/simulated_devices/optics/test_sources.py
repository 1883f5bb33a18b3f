"""Sources: areas against closed forms, symmetry, MATLAB's peaks, orientation of images."""

from __future__ import annotations

import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from support.optics import sensor_of
from support.paths import DOCS

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Lattice
from simulated_devices.optics import source
from simulated_devices.optics.forward_model import ForwardModel
from simulated_devices.rendering import Scene
from simulated_devices.settings import MASKS, Simulation, Source

HALF_M = 0.6e-3
N = 37


def brightness(mask: str, settings: Source | None = None, samples: int = N) -> Floats:
    """Area over that of the square's point, (row, column)."""
    points = source.source_points(mask, settings or Source(), object_samples=samples)
    whole = source.source_points("square", Source(), object_samples=samples)
    np.testing.assert_array_equal(points.position_m, whole.position_m)
    return np.asarray(points.area_m2 / whole.area_m2).reshape(samples, samples)


@pytest.mark.parametrize("samples", [36, 37])
@pytest.mark.parametrize(
    ("mask", "area_m2"),
    [
        ("square", 4 * HALF_M**2),
        ("circle", math.pi * HALF_M**2),
        ("ellipse", math.pi * HALF_M**2 * 0.6),
        ("octagon", 8 * (math.sqrt(2) - 1) * HALF_M**2),
    ],
)
def test_opening_has_its_area_and_second_moments(mask: str, area_m2: float, samples: int) -> None:
    points = source.source_points(mask, Source(), object_samples=samples)
    assert points.area_m2.sum() == pytest.approx(area_m2, rel=2e-4)
    found = (points.area_m2[:, None] * points.position_m**2).sum(axis=0) / area_m2
    side_m = 2 * HALF_M * math.tan(math.pi / 8)
    octagon = (12 * HALF_M**2 + side_m**2) / 48  # of any regular polygon about its middle
    expected = {
        "square": (HALF_M**2 / 3, HALF_M**2 / 3),
        "circle": (HALF_M**2 / 4, HALF_M**2 / 4),
        "ellipse": (HALF_M**2 / 4, (0.6 * HALF_M) ** 2 / 4),
        "octagon": (octagon, octagon),
    }[mask]
    np.testing.assert_allclose(found, expected, rtol=0.01)


def test_checkerboard_is_lit_in_its_first_corner_and_every_other_cell() -> None:
    found = brightness("checkerboard")
    assert found.sum() == pytest.approx(N**2 / 2, rel=0.01)
    middles = 3 + 6 * np.arange(6)  # of the cells; 36 steps are 6 cells of 6
    np.testing.assert_allclose(found[np.ix_(middles, middles)], (np.indices((6, 6)).sum(axis=0) + 1) % 2, atol=1e-12)
    assert found[0, 0] == pytest.approx(1)
    assert found[0, 6] == pytest.approx(0.5)  # on an edge
    four = brightness("checkerboard", Source(checker_cells=4))
    assert (four[4, 4], four[4, 13]) == pytest.approx((1, 0))
    points = source.source_points("checkerboard", Source(), object_samples=N)
    assert points.area_m2.sum() == pytest.approx(2 * HALF_M**2)


def test_optimised_mask_has_the_cells_of_the_documentation() -> None:
    page = (DOCS / "masks.md").read_text("utf-8")
    rows = re.findall(r"^    ([#.]{6})$", page, re.MULTILINE)
    cells = np.array([[cell == "#" for cell in row] for row in rows])
    middles = 3 + 6 * np.arange(6)
    np.testing.assert_allclose(brightness("optimised")[np.ix_(middles, middles)], cells, atol=1e-12)
    np.testing.assert_array_equal(cells, cells[::-1, ::-1])  # its light is centred
    points = source.source_points("optimised", Source(), object_samples=N)
    assert points.area_m2.sum() == pytest.approx(16 * (0.2e-3) ** 2)


def test_openings_have_the_shapes_of_their_names() -> None:
    points = source.source_points("square", Source(), object_samples=N).position_m / HALF_M
    x, y = np.abs(points).T
    sizes = {
        "circle": np.hypot(x, y),
        "ellipse": np.hypot(x, y / 0.6),
        "octagon": np.maximum(np.maximum(x, y), (x + y) / math.sqrt(2)),
    }
    for mask, size in sizes.items():
        found = brightness(mask).ravel()
        margin = 0.05 / (0.6 if mask == "ellipse" else 1)  # half a cell's diagonal
        np.testing.assert_allclose(found[size < 1 - margin], 1, atol=1e-12)
        np.testing.assert_array_equal(found[size > 1 + margin], 0)


def test_peaks_match_matlab() -> None:
    n = 601  # steps of 0.01
    found = brightness("peaks", samples=n)
    along = np.linspace(-3, 3, n)
    row, column = np.unravel_index(found.argmax(), found.shape)
    assert (along[column], along[row]) == pytest.approx((-0.0093, 1.5814), abs=0.006)
    row, column = np.unravel_index(found.argmin(), found.shape)
    assert (along[column], along[row]) == pytest.approx((0.2283, -1.6255), abs=0.006)
    assert found.min() == pytest.approx(0, abs=1e-4)
    assert found.max() == pytest.approx(1, abs=1e-4)
    middle = 3 * math.exp(-1) - math.exp(-1) / 3  # peaks(0, 0) by hand: 0.9810
    assert found[300, 300] == pytest.approx((middle + 6.5511) / (8.1062 + 6.5511), abs=1e-4)
    assert found[0, 0] == pytest.approx(6.5511 / (8.1062 + 6.5511), abs=1e-3)  # flat far away


def write_image(path: Path, pixels: np.ndarray) -> Source:
    if path.suffix == ".npy":
        np.save(path, pixels)
    elif path.suffix == ".tif":
        tifffile.imwrite(path, pixels)
    else:
        cv2.imwrite(str(path), pixels)
    return Source(file=str(path))


@pytest.mark.parametrize("suffix", [".npy", ".tif", ".png"])
def test_bright_corner_of_image_keeps_its_corner(tmp_path: Path, suffix: str) -> None:
    pixels = np.zeros((60, 60), np.uint16)
    pixels[:20, 40:] = 40000  # top right: low y, high x
    settings = write_image(tmp_path / f"corner{suffix}", pixels)
    found = brightness("image", settings)
    assert found[0, -1] == 1
    assert found[:12, 25:].min() == pytest.approx(1)
    assert found[14:].max() == 0
    assert found[:, :23].max() == 0
    sensor = sensor_of(2, 3)
    lattice = Lattice(center_x_px=46.5, center_y_px=31.0, pitch_px=31.0)
    field = Field(collimator_focal_length_m=0.2, half_width_m=HALF_M)
    model = ForwardModel(
        sensor, lattice, field, shape=(62, 93), pupil_samples=12, pixel_fill_factor=1.0, border_lenslets=0
    )
    subimage = model.irradiance(source.source_points("image", settings, object_samples=13))[:31, 31:62]
    row, column = np.unravel_index(subimage.argmax(), subimage.shape)
    assert row < 12
    assert column > 19


def test_image_is_resampled_by_area(tmp_path: Path) -> None:
    pixels = np.random.default_rng(5).uniform(size=(40, 90))
    found = source.source_points("image", write_image(tmp_path / "a.npy", pixels), object_samples=11)
    light = found.area_m2.sum()
    mean = pixels.mean() * 40 / 90  # the rest of the square is dark
    whole = source.source_points("square", Source(), object_samples=11).area_m2
    brightest = np.max(found.area_m2 / whole)
    assert brightest == pytest.approx(1)
    again = source.source_points("image", write_image(tmp_path / "b.npy", 7 * pixels), object_samples=11)
    np.testing.assert_allclose(again.area_m2, found.area_m2)
    cells = found.area_m2.reshape(11, 11) / whole.reshape(11, 11)
    first = pixels[:, :4].mean(axis=1) * 4 + pixels[:, 4] * 0.5  # 90 pixels in 10 cells: the edge cell has 4.5
    edge = first[20 - 4 : 20 + 4].sum() + first[[15, 24]].sum() * 0.5  # the middle cell has rows 15.5 ... 24.5
    assert cells[5, 0] / light == pytest.approx(edge / (4.5 * 9) / (mean * 4 * HALF_M**2), rel=1e-9)
    assert not cells[:3].any()


def test_bad_image_raises_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_bytes(b"no image")
    (tmp_path / "text.tif").write_bytes(b"no image")
    (tmp_path / "cut.tif").write_bytes(b"II*\0")
    (tmp_path / "text.npy").write_bytes(b"")
    (tmp_path / "empty.png").write_bytes(b"")
    for name in ("text.png", "text.tif", "cut.tif", "text.npy", "empty.png", "absent.png", "absent.npy"):
        with pytest.raises(ValueError, match=r"^file = .* is not a readable image: "):
            source.read_grey_image(tmp_path / name)
    with pytest.raises(ValueError, match=r"is not a readable image: (Is a directory|Permission denied)$"):
        source.read_grey_image(tmp_path)
    for name, array in (("3d.npy", np.ones((4, 4, 3))), ("text.npy", np.array([["a"]])), ("none.npy", np.ones((0, 3)))):
        np.save(tmp_path / name, array)
        with pytest.raises(ValueError, match=r"^file = .* must hold one grey image"):
            source.read_grey_image(tmp_path / name)
    for name, array in (
        ("dark.npy", np.zeros((4, 4))),
        ("minus.npy", -np.eye(3)),
        ("nan.npy", np.full((3, 3), np.nan)),
    ):
        np.save(tmp_path / name, array)
        with pytest.raises(ValueError, match=r"^file = .* must hold finite brightness"):
            source.read_grey_image(tmp_path / name)


def test_image_mask_needs_a_file() -> None:
    assert Source().masks == tuple(mask for mask in MASKS if mask != "image")
    assert Source(file="a.png", mask="image").masks == MASKS
    with pytest.raises(ValueError, match="needs a file"):
        Source(mask="image")


def test_fingerprint_depends_on_mask_file_not_on_initial_mask(tmp_path: Path) -> None:
    def fingerprint(settings: Source) -> str:
        return Scene(
            sensor=sensor_of(2, 3),
            lattice=Lattice(center_x_px=46.5, center_y_px=31.0, pitch_px=31.0),
            field=Field(collimator_focal_length_m=0.2, half_width_m=HALF_M),
            simulation=Simulation(source=settings),
            rows=62,
            columns=93,
            pixel_fill_factor=1.0,
        ).fingerprint()

    assert fingerprint(Source(mask="circle")) == fingerprint(Source())
    assert fingerprint(Source(ellipse_ratio=0.5)) != fingerprint(Source())
    settings = write_image(tmp_path / "a.npy", np.eye(4))
    before = fingerprint(settings)
    write_image(tmp_path / "a.npy", np.eye(5))
    assert fingerprint(settings) != before
    with pytest.raises(ValueError, match="cannot be read"):
        fingerprint(Source(file=str(tmp_path / "absent.png")))

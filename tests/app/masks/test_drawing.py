"""Drawings of masks, read back by other programs and compared with the simulator's own picture of each mask."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import ezdxf
import ezdxf.path
import gdstk
import numpy as np
import pytest
from matplotlib.path import Path as Outline
from numpy.typing import NDArray
from support.command_line import run

from app.bench.config import load_bench
from app.masks.drawing import drawing_of
from app.masks.openings import openings
from simulated_devices.optics.source import source_points
from simulated_devices.settings import MASKS, Source

Floats = NDArray[np.float64]
HALF_M = 0.6e-3
PICTURE = np.array([[1, 1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 1]], np.uint8)  # unlike any turned or mirrored one
AREAS_MM2 = {  # closed forms, for a field of 1.2 mm
    "square": 1.44,
    "checkerboard": 0.72,
    "optimised": 0.64,
    "circle": math.pi * 0.36,
    "ellipse": math.pi * 0.36 * 0.6,
    "octagon": 8 * (math.sqrt(2) - 1) * 0.36,
    "stars": 9 * math.pi * 0.025**2,
    "picture.npy": 6 * 0.3**2,
}
WIDTHS_UM = {  # of the narrowest opening, and of the narrowest gap
    "square": ("1200", None),
    "checkerboard": ("200", "200"),
    "optimised": ("200", "200"),
    "circle": ("1200", None),
    "ellipse": ("720", None),
    "octagon": ("1200", None),
    "stars": ("50", "450"),
    "picture.npy": ("300", "300"),
}


@dataclass(frozen=True, eq=False)
class Plate:
    """Shapes read back from a file, mm, y downwards."""

    is_open: Callable[[Floats], NDArray[np.bool_]]  # of points (point, xy)
    corners: dict[str, Floats]  # lowest and highest (x, y) of each layer
    area_mm2: float  # of the openings
    text: str


def of_outlines(layers: dict[str, list[Floats]], text: str) -> Plate:
    """Plate whose layers are outlines (corner, xy)."""
    outlines = [Outline(each) for shapes in layers.values() for each in shapes]

    def is_open(points: Floats) -> NDArray[np.bool_]:
        return np.asarray(np.any([each.contains_points(points) for each in outlines], axis=0))

    corners = {
        name: np.array([np.concatenate(shapes).min(axis=0), np.concatenate(shapes).max(axis=0)])
        for name, shapes in layers.items()
    }
    area = sum(cv2.contourArea((each - each[0]).astype(np.float32)) for each in layers["openings"])
    return Plate(is_open, corners, area, text)


def read_svg(path: Path) -> Plate:
    page, names = ET.parse(path).getroot(), {"svg": "http://www.w3.org/2000/svg"}  # noqa: S314 - our own file
    width_mm, height_mm = (float(page.attrib[key].removesuffix("mm")) for key in ("width", "height"))
    view = [float(each) for each in page.attrib["viewBox"].split()]
    assert view == pytest.approx(
        [-width_mm / 2, -height_mm / 2, width_mm, height_mm], abs=2e-6
    )  # so that a unit is a millimetre
    layers: dict[str, list[Floats]] = {}
    for group in page.findall("svg:g", names):
        shapes = layers.setdefault(group.attrib["id"], [])
        for each in group:
            shapes.append(np.array([point.split(",") for point in each.attrib["points"].split()], np.float64))
    return of_outlines(layers, page.findtext("svg:desc", "", names))


def read_dxf(path: Path) -> Plate:
    document = ezdxf.filemanagement.readfile(path)
    assert not document.audit().errors
    assert document.header["$INSUNITS"] == 13  # micrometres
    layers: dict[str, list[Floats]] = {}
    for each in document.modelspace():
        if each.dxftype() != "TEXT":
            points = ezdxf.path.make_path(each).flattening(0.01)
            outline = np.array([(point.x, -point.y) for point in points]) / 1e3
            layers.setdefault(each.dxf.layer.lower(), []).append(outline)
    return of_outlines(layers, ". ".join(text.dxf.text for text in document.modelspace().query("TEXT")))


def read_gds(path: Path) -> Plate:
    library = gdstk.read_gds(path)
    assert (library.unit, library.precision) == pytest.approx((1e-6, 1e-9))
    (cell,) = library.cells
    assert isinstance(cell, gdstk.Cell)
    names, layers = {1: "openings", 2: "scale_bar", 3: "orientation_mark"}, dict[str, list[Floats]]()
    for each in cell.polygons:
        layers.setdefault(names[each.layer], []).append(np.asarray(each.points) * (1e-3, -1e-3))
    return of_outlines(layers, ". ".join(label.text for label in cell.labels))


READERS = {".svg": read_svg, ".dxf": read_dxf, ".gds": read_gds}


@pytest.fixture
def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Plate]:
    """Draws a mask with the command and reads the file."""
    monkeypatch.chdir(tmp_path)
    np.save("picture.npy", np.kron(PICTURE, np.ones((5, 5), np.uint8)))

    def draw(name: str, suffix: str, *options: str) -> Plate:
        assert run(monkeypatch, "mask", name, "--out", f"mask{suffix}", "--overwrite", *options) == 0
        return READERS[suffix](tmp_path / f"mask{suffix}")

    return draw


def simulated(name: str) -> Source:
    return Source(mask="image", file=name) if name.endswith(".npy") else Source()


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize("name", ["optimised", "octagon"])
def test_openings_are_those_of_the_simulator(name: str, suffix: str, drawn: Callable[..., Plate]) -> None:
    plate = drawn(name, suffix, "--size", "1.2mm")
    samples, fine = 37, 6  # points of the simulator along a side, and places in half a step between them
    along = (np.arange(2 * fine * (samples - 1)) + 0.5) / (2 * fine * (samples - 1)) * 1.2 - 0.6
    y, x = np.meshgrid(along, along, indexing="ij")
    is_open = plate.is_open(np.stack([x.ravel(), y.ravel()], axis=-1)).reshape(x.shape)
    edges = np.array([0, *range(fine, len(along), 2 * fine)])
    found = np.add.reduceat(np.add.reduceat(is_open.astype(float), edges, axis=0), edges, axis=1)
    found *= (along[1] - along[0]) ** 2
    kind = "image" if name.endswith(".npy") else name
    points = source_points(kind, simulated(name), object_samples=samples)
    expected = points.area_m2.reshape(samples, samples) * 1e6
    assert np.abs(found - expected).max() < 0.12 * (1.2 / (samples - 1)) ** 2  # of a cell through which an edge goes
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize("name", AREAS_MM2)
def test_area_box_and_marks_are_true_to_size(name: str, suffix: str, drawn: Callable[..., Plate]) -> None:
    plate = drawn(name, suffix)  # 1.2 mm: that of the bench
    assert plate.area_mm2 == pytest.approx(AREAS_MM2[name], rel=2e-3)
    points = source_points("stars", Source(), object_samples=2).position_m * 1e3
    assert plate.is_open(points).all() == (name in {"stars", "square"})
    half = {"stars": (0.525, 0.525), "ellipse": (0.6, 0.36), "picture.npy": (0.6, 0.45)}.get(name, (0.6, 0.6))
    assert plate.corners["openings"] == pytest.approx(np.array([half, half]) * [[-1], [1]], abs=2e-3)
    hole = float(plate.text.rpartition("circle of ")[2].partition(" mm")[0]) / 2
    for mark in ("scale_bar", "orientation_mark"):
        (left, top), (right, bottom) = plate.corners[mark]
        nearest = np.hypot(max(left, -right, 0), max(top, -bottom))
        assert nearest > hole - 2e-3 > math.sqrt(0.5) * 1.2
    (left, _), (right, _) = plate.corners["scale_bar"]
    assert right - left == pytest.approx(0.5, abs=1e-6)
    assert "scale bar 500 um" in plate.text
    width, gap = WIDTHS_UM[name]
    assert f"minimum feature {width} um, {f'minimum gap {gap} um' if gap else 'no gap below 600 um'}" in plate.text


@pytest.mark.parametrize("suffix", READERS)
def test_orientation_mark_is_an_upright_f_at_the_upper_left(suffix: str, drawn: Callable[..., Plate]) -> None:
    plate = drawn("square", suffix)
    (left, top), (right, bottom) = plate.corners["orientation_mark"]
    assert left == pytest.approx(-0.6, abs=2e-3)
    assert right < 0
    assert bottom < -0.6
    y, x = np.meshgrid([0.1, 0.3, 0.5, 0.9], [0.1, 0.5, 0.9], indexing="ij")  # of its height and width
    inside = plate.is_open(np.stack([left + x.ravel() * (right - left), top + y.ravel() * (bottom - top)], axis=-1))
    assert inside.reshape(4, 3).tolist() == [
        [True, True, True],
        [True, False, False],
        [True, True, False],
        [True, False, False],
    ]


def test_size_scales_openings_and_bench_sets_their_proportions(drawn: Callable[..., Plate]) -> None:
    plate = drawn("stars", ".gds", "--size", "2400 um", "--set", "simulation.source.pinhole_diameter_m=30e-6")
    assert plate.area_mm2 == pytest.approx(9 * math.pi * 0.03**2, rel=2e-3)
    assert plate.corners["openings"].max() == pytest.approx(1.03, abs=1e-5)
    plate = drawn("checkerboard", ".svg", "--size", "0.0016m", "--set", "simulation.source.checker_cells=4")
    assert "minimum feature 400 um, minimum gap 400 um; openings touch at 9 corners" in plate.text


@pytest.mark.parametrize(("name", "half"), [("circle", (600, 600)), ("ellipse", (600, 360))])
def test_round_openings_are_round(name: str, half: tuple[float, float]) -> None:
    (corners_m,) = openings(name, Source(), 1.2e-3).polygons_m
    middles_m = (corners_m + np.roll(corners_m, 1, axis=0)) / 2
    for points_m in (corners_m, middles_m):
        assert np.abs(np.hypot(*(points_m * 1e6 / half).T) - 1).max() * 600 < 0.01


@pytest.mark.parametrize(("name", "ratio"), [("circle", 1.0), ("ellipse", 0.6)])
def test_polygon_has_the_area_of_its_ellipse(name: str, ratio: float) -> None:
    assert openings(name, Source(), 1e-3).area_m2 == pytest.approx(math.pi / 4 * ratio * 1e-6, rel=1e-9)


def test_notes_lie_below_the_page() -> None:
    drawing = drawing_of(openings("square", Source(), 1.2e-3))
    x_um, y_um = np.transpose(drawing.note_places_um)
    assert x_um == pytest.approx(np.full(len(drawing.notes), -1e6 * drawing.half_x_m))
    assert np.all(np.diff([-1e6 * drawing.half_y_m, *y_um]) < -48)  # um: one letter of 0.04 times 1.2 mm, y upwards


def test_every_mask_is_drawn_or_refused() -> None:
    assert {*AREAS_MM2, "peaks", "image"} - {"picture.npy"} == set(MASKS)


def test_picture_of_the_bench_is_drawn(drawn: Callable[..., Plate]) -> None:
    plate = drawn("image", ".svg", "--set", "simulation.source.file='picture.npy'")
    assert plate.area_mm2 == pytest.approx(AREAS_MM2["picture.npy"])


def test_resolution_of_the_bench_is_compared(drawn: Callable[..., Plate], capsys: pytest.CaptureFixture[str]) -> None:
    bench = load_bench("paper_simulation")
    blur_um = 1e6 * bench.sensor.wavelength_m * bench.field.collimator_focal_length_m / bench.sensor.lenslet_pitch_m
    assert blur_um == pytest.approx(184.8)
    drawn("checkerboard", ".svg")
    said = capsys.readouterr().out
    assert "mask.svg: mask checkerboard, field 1.2 mm" in said
    assert "the lenslets of paper_simulation resolve 185 um" in said
    assert "0.72 mm2 of 1.44 mm2 are open" in said
    assert "warning" not in said
    drawn("checkerboard", ".svg", "--size", "1.1mm", "--bench", "small_demo")
    said = capsys.readouterr().out
    assert "the minimum feature of 183.3 um is finer than what the lenslets resolve" in said
    assert "the minimum gap of 183.3 um is finer" in said
    drawn("square", ".svg", "--size", "2.2mm")
    assert "subimages of masks above 2.14 mm overlap" in capsys.readouterr().out

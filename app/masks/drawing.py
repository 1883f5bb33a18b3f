"""Drawings of masks for a lithographer as SVG, DXF or GDSII, with marks and notes.

The plate is seen from the lenslets, with x to the right and y downwards; in DXF and GDSII, whose y points upwards,
it looks the same. Filled shapes let light through.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch
from xml.etree import ElementTree as ET

import numpy as np

from app.errors import InputError
from app.files import atomic_write
from app.masks.openings import TOLERANCE_M, Openings, rectangle
from reconstruction.arrays import Floats

_LAYERS = {"OPENINGS": 1, "SCALE_BAR": 2, "ORIENTATION_MARK": 3, "NOTES": 4}  # their numbers in GDSII
_UPWARDS_UM = 1e6, -1e6
_NOTE_HEIGHT = 0.04  # over the size of the mask
_CLEARANCE = 1.06  # of the marks from the circle about all openings
_LETTER_F = np.array(  # (corner, xy) in a square of side 1; no turned or mirrored one is the same
    [(0, 0), (0.6, 0), (0.6, 0.2), (0.2, 0.2), (0.2, 0.4), (0.5, 0.4), (0.5, 0.6), (0.2, 0.6), (0.2, 1), (0, 1)]
)
_GDS_CORNERS = 8190  # of a polygon at most


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing:
    """Mask with its marks, outside the circle of radius `hole_m` that holds all openings."""

    openings: Openings
    hole_m: float
    scale_bar_m: float
    layers: dict[str, tuple[Floats, ...]]  # polygons (corner, xy) of all but the notes
    half_x_m: float  # of the page
    half_y_m: float

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the lithographer, ASCII."""
        mask = self.openings
        name = "".join(each if each.isascii() and each.isprintable() else "?" for each in mask.name)
        gap = f"minimum gap {_um(mask.gap_m)} um" if mask.gap_m else f"no gap below {_um(mask.size_m / 2)} um"
        touching = f"; openings touch at {mask.touching} corners" if mask.touching else ""
        return (
            f"mask {name}, field {_mm(mask.size_m)} mm",
            f"{mask.area_m2 * 1e6:.4g} mm2 of {mask.size_m**2 * 1e6:.4g} mm2 are open",
            f"minimum feature {_um(mask.width_m)} um, {gap}{touching}",
            "drawn as seen from the lenslets; the chrome faces them (right-reading, chrome up); the F is upper left",
            f"the mount must cover the marks: they lie outside a circle of {_mm(2 * self.hole_m)} mm",
            f"scale bar {_um(self.scale_bar_m)} um; round edges are polygons within {TOLERANCE_M * 1e9:g} nm",
            "filled shapes are transparent, all else is opaque",
        )

    @property
    def note_places_um(self) -> list[tuple[float, float]]:
        """Lower left corners of the notes, below the page, y upwards."""
        step_m = 1.5 * _NOTE_HEIGHT * self.openings.size_m
        lines = range(1, 1 + len(self.notes))
        return [(-self.half_x_m * 1e6, -(self.half_y_m + line * step_m) * 1e6) for line in lines]


def _mm(length_m: float) -> str:
    return f"{length_m * 1e3:.4g}"


def _um(length_m: float) -> str:
    return f"{length_m * 1e6:.4g}"


def drawing_of(mask: Openings) -> Drawing:
    """Draw a mask: below it a scale bar, above it at the left the letter F."""
    hole_m = _CLEARANCE * mask.reach_m
    height_m = 0.15 * mask.size_m
    bar_m = _round_length(mask.size_m / 2)
    bar = rectangle(-bar_m / 2, hole_m, bar_m / 2, hole_m + height_m / 4)
    letter = _LETTER_F * height_m + (-mask.size_m / 2, -hole_m - height_m)
    return Drawing(
        openings=mask,
        hole_m=hole_m,
        scale_bar_m=bar_m,
        layers={"OPENINGS": mask.polygons_m, "SCALE_BAR": (bar,), "ORIENTATION_MARK": (letter,)},
        half_x_m=hole_m,
        half_y_m=hole_m + 1.2 * height_m,
    )


def _round_length(most_m: float) -> float:
    """Return the largest of 1, 2, 5, 10, ... nm up to a length."""
    decade = 10.0 ** math.floor(math.log10(most_m * 1e9))
    return max(step * decade for step in (1, 2, 5) if step * decade <= most_m * 1e9) * 1e-9


def write_drawing(drawing: Drawing, path: Path) -> None:
    """Write a drawing in the format of its suffix, one of `WRITERS`; `InputError` without the extra."""
    try:
        with atomic_write(path) as temporary:
            WRITERS[path.suffix.lower()](drawing, temporary)
    except ImportError as error:
        raise InputError(
            f"{path}: this format needs {error.name}: install the extra svwfs[mask], or write .svg"
        ) from error


def _write_svg(drawing: Drawing, path: Path) -> None:
    """Write lengths in mm: openings, scale bar and mark are groups with these names."""
    half_x, half_y = 1e3 * drawing.half_x_m, 1e3 * drawing.half_y_m
    page = ET.Element(
        "svg",
        {
            "xmlns": "http://www.w3.org/2000/svg",
            "width": f"{2 * half_x:.6f}mm",
            "height": f"{2 * half_y:.6f}mm",
            "viewBox": f"{-half_x:.6f} {-half_y:.6f} {2 * half_x:.6f} {2 * half_y:.6f}",
            "shape-rendering": "crispEdges",  # else edges that openings share would show
        },
    )
    ET.SubElement(page, "title").text = drawing.notes[0]
    ET.SubElement(page, "desc").text = ". ".join(drawing.notes)
    for name, polygons_m in drawing.layers.items():
        group = ET.SubElement(page, "g", id=name.lower())
        for corners_m in polygons_m:
            ET.SubElement(group, "polygon", points=" ".join(f"{x:.6f},{y:.6f}" for x, y in 1e3 * corners_m))
    ET.ElementTree(page).write(path, "utf-8", xml_declaration=True)


def _write_dxf(drawing: Drawing, path: Path) -> None:
    """Write closed polylines in micrometres."""
    with patch("configparser.ConfigParser.read"):  # which would read ezdxf.ini of the working folder
        from ezdxf.enums import InsertUnits
        from ezdxf.filemanagement import new

    document = new("R2010", units=int(InsertUnits.Microns))
    space = document.modelspace()
    for name in _LAYERS:
        document.layers.add(name)
    for name, polygons_m in drawing.layers.items():
        for corners_m in polygons_m:
            space.add_lwpolyline((corners_m * _UPWARDS_UM).tolist(), close=True, dxfattribs={"layer": name})
    height = _NOTE_HEIGHT * drawing.openings.size_m * 1e6
    for note, place in zip(drawing.notes, drawing.note_places_um, strict=True):
        space.add_text(note, height=height, dxfattribs={"layer": "NOTES"}).set_placement(place)
    document.saveas(path)


def _write_gds(drawing: Drawing, path: Path) -> None:
    """Write polygons in micrometres on a grid of 1 nm."""
    import gdstk

    library = gdstk.Library("SVWFS", unit=1e-6, precision=1e-9)
    cell = library.new_cell("MASK")
    for name, polygons_m in drawing.layers.items():
        cell.add(*(gdstk.Polygon((corners_m * _UPWARDS_UM).tolist(), layer=_LAYERS[name]) for corners_m in polygons_m))
    for note, place in zip(drawing.notes, drawing.note_places_um, strict=True):
        cell.add(gdstk.Label(note, place, anchor="sw", layer=_LAYERS["NOTES"]))
    library.write_gds(path, max_points=_GDS_CORNERS)


WRITERS: dict[str, Callable[[Drawing, Path], None]] = {".svg": _write_svg, ".dxf": _write_dxf, ".gds": _write_gds}

"""Geometry of the sensor, of its lenslet lattice on the camera, and of the field of view.

The lattice frame is the frame of the whole instrument: pupil positions (u, v) and field positions (x, y) are measured
along the lattice's columns and rows, from its middle, in metres. Only `Lattice` knows how that frame lies on the
camera. Every vector has (x, y) as its last axis; every image is [row, column] with pixel centres at integers.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self, TypeAlias

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Doc

from reconstruction.annotated_settings import Checked
from reconstruction.arrays import Booleans, Floats
from reconstruction.errors import ReconstructionError
from reconstruction.pupil import Pupil

Arrangement: TypeAlias = Literal["square", "hexagonal"]
"""Of the lenslets: in a hexagonal one, rows lie sqrt(3)/2 pitches apart and odd rows half a pitch to the right."""

_ROW_SPACING = {"square": 1.0, "hexagonal": math.sqrt(3) / 2}  # in pitches
_ROW_OFFSET = {"square": 0.0, "hexagonal": 0.25}  # of a row from the lattice's middle, odd rows to +x, in pitches

_MOST_LENSLETS = 40_000

STARS, STAR_SPACING_M = 3, 0.5e-3  # the paper's grid of stars, on a side; the views of the field lie at them


def require(conditions: Mapping[str, bool]) -> None:
    """Raise `ValueError` with the first sentence whose condition is false."""
    for sentence, holds in conditions.items():
        if not holds:
            raise ValueError(sentence)


_Count = Annotated[int, Ge(2), Le(1000)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor(Checked):
    """A lenslet array in front of a camera."""

    lenslet_rows: Annotated[_Count, Doc("Lenslets along y. Omitted: as the reference shows")] | None = None
    lenslet_columns: Annotated[_Count, Doc("Lenslets along x. Omitted: as the reference shows")] | None = None
    lenslet_pitch_m: Annotated[float, Ge(1e-6), Le(0.1), Doc("Distance between two lenslets, from the data sheet")]
    lenslet_focal_length_m: Annotated[
        float, Ge(1e-5), Le(2), Doc("Focal length of a lenslet at the wavelength; the camera is in its focal plane")
    ]
    wavelength_m: Annotated[float, Ge(100e-9), Le(20e-6), Doc("Wavelength of the light in vacuum")]
    pixel_pitch_m: Annotated[float, Ge(1e-7), Le(1e-3), Doc("Distance of two camera pixels; binned pixels are larger")]
    arrangement: Arrangement = "square"  # bench files have it in [lattice]
    pupil: Pupil = Pupil()  # bench files have it in [pupil]

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if (self.lenslet_rows or 1) * (self.lenslet_columns or 1) > _MOST_LENSLETS:
            yield "lenslet_rows", f"times lenslet_columns must be at most {_MOST_LENSLETS}"
        if self.lenslet_pitch_m < 8 * self.pixel_pitch_m:
            yield "lenslet_pitch_m", "must be at least 8 pixels"

    @property
    def lenslets(self) -> tuple[int, int]:
        """Rows and columns of lenslets, of which some may be absent; `ReconstructionError` if a reference must tell."""
        if self.lenslet_rows is None or self.lenslet_columns is None:
            raise ReconstructionError(
                "sensor.lenslet_rows and lenslet_columns are omitted, and only a reference shows them: set them"
            )
        return self.lenslet_rows, self.lenslet_columns

    @property
    def wavenumber_rad_per_m(self) -> float:
        """k = 2 pi / wavelength."""
        return 2 * math.pi / self.wavelength_m

    @property
    def lenslet_pitch_px(self) -> float:
        """Designed lenslet pitch in camera pixels; `Lattice.pitch_px` is the measured one."""
        return self.lenslet_pitch_m / self.pixel_pitch_m

    @property
    def slope_per_px(self) -> float:
        """Wavefront slope (rad/m) that displaces the light by one pixel: displacement = (f/k) dphi/du."""
        return self.pixel_pitch_m * self.wavenumber_rad_per_m / self.lenslet_focal_length_m

    @property
    def blur_px(self) -> float:
        """Distance from its peak at which the image of a point first vanishes, px."""
        return self.wavelength_m * self.lenslet_focal_length_m / self.lenslet_pitch_m / self.pixel_pitch_m

    @property
    def row_spacing_m(self) -> float:
        """Distance between two lenslet rows."""
        return self.lenslet_pitch_m * _ROW_SPACING[self.arrangement]

    @property
    def aperture_width_m(self) -> float:
        """Side of the square around the aperture of a lenslet: a square, or a hexagon with corners at +-y."""
        return self.lenslet_pitch_m / _ROW_SPACING[self.arrangement]

    @property
    def pupil_half_width_m(self) -> tuple[float, float]:
        """Half the width of the lattice along x and y, where the normalised pupil position is 1."""
        rows, columns = self.lenslets
        columns_wide = columns + 2 * _ROW_OFFSET[self.arrangement]
        return columns_wide * self.lenslet_pitch_m / 2, rows * self.row_spacing_m / 2

    @property
    def lenslet_centers_m(self) -> Floats:
        """Pupil positions of the lenslet centres, (lenslet_row, lenslet_column, xy)."""
        return lenslet_centers(self.arrangement, *self.lenslets) * self.lenslet_pitch_m

    @property
    def is_in_pupil(self) -> Booleans:
        """True for lenslets whose centres lie in the pupil, (lenslet_row, lenslet_column)."""
        return self.pupil.contains(self.lenslet_centers_m)

    @property
    def circle(self) -> Pupil:
        """Circle or annulus of the Zernike modes: the pupil's, or that inscribed in a square or in the lattice."""
        if not self.pupil.is_bounded:
            return Pupil(shape="circle", radius_m=min(self.pupil_half_width_m))
        return replace(self.pupil, shape="circle") if self.pupil.shape == "square" else self.pupil

    def with_pupil(self, lit: Booleans) -> Self:
        """Fit the pupil, if it is to be fitted, to the lit lenslets (lenslet_row, lenslet_column)."""
        cell_m2 = self.lenslet_pitch_m * self.row_spacing_m
        return replace(self, pupil=self.pupil.found(self.lenslet_centers_m, lit, cell_m2))

    @property
    def pupil_x_m(self) -> Floats:
        """Pupil position of the centres of the lenslet columns, (lenslet_column,); only in a square lattice."""
        require({"lenslet columns have one x position only in a square lattice": self.arrangement == "square"})
        return centered_steps(self.lenslets[1]) * self.lenslet_pitch_m

    @property
    def pupil_y_m(self) -> Floats:
        """Pupil position of the centres of the lenslet rows, (lenslet_row,)."""
        return centered_steps(self.lenslets[0]) * self.row_spacing_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice(Checked):
    """Position of the lenslets on the camera; a positive rotation turns +x towards +y."""

    center_x_px: Annotated[float, Ge(-1e5), Le(1e5), Doc("Centre of the lattice in the frame")]
    center_y_px: Annotated[float, Ge(-1e5), Le(1e5)]
    pitch_px: Annotated[float, Ge(8), Le(10_000), Doc("Measured distance between two lenslets")]
    rotation_rad: Annotated[float, Ge(-0.8), Le(0.8)] = 0.0
    arrangement: Annotated[Arrangement, Doc("Arrangement of the lenslets")] = "square"
    stretch: (
        Annotated[
            tuple[Annotated[float, Ge(-0.1), Le(0.1)], Annotated[float, Ge(-0.1), Le(0.1)]],
            Doc("Excess of the pitch along x and along the diagonal over its mean, relative. Omitted: none"),
        ]
        | None
    ) = None

    @property
    def turn(self) -> Floats:
        """Matrix (2, 2) from row vectors in the lattice frame to those on the camera."""
        cosine, sine = math.cos(self.rotation_rad), math.sin(self.rotation_rad)
        return np.array([[cosine, sine], [-sine, cosine]])

    def to_camera_px(self, position_px: Floats) -> Floats:
        """Camera positions of lattice positions (..., xy), px from the lattice's middle."""
        return np.asarray(position_px @ self.turn + [self.center_x_px, self.center_y_px])

    def from_camera_px(self, position_px: Floats) -> Floats:
        """Lattice positions, px from the lattice's middle, of camera positions (..., xy)."""
        return np.asarray((position_px - [self.center_x_px, self.center_y_px]) @ self.turn.T)

    @property
    def pitch_matrix_px(self) -> Floats:
        """Symmetric matrix (2, 2) from row vectors in pitches to those in px along the lattice."""
        along_x, diagonal = self.stretch or (0.0, 0.0)
        return self.pitch_px * np.array([[1 + along_x, diagonal], [diagonal, 1 - along_x]])

    def pitch_text(self, digits: int) -> str:
        """The pitch in words; the least and the largest if it depends on the direction."""
        uneven = math.hypot(*self.stretch or ())
        pitches_px = {self.pitch_px * (1 - uneven): None, self.pitch_px * (1 + uneven): None}
        return " x ".join(f"{pitch_px:.{digits}f}" for pitch_px in pitches_px) + " px"

    def camera_px(self, position: Floats) -> Floats:
        """Camera positions of lattice positions (..., xy), pitches from the lattice's middle."""
        return self.to_camera_px(position @ self.pitch_matrix_px)

    def in_pitches(self, position_px: Floats) -> Floats:
        """Lattice positions, pitches from the lattice's middle, of camera positions (..., xy)."""
        return np.asarray(self.from_camera_px(position_px) @ np.linalg.inv(self.pitch_matrix_px))

    @property
    def row_spacing(self) -> float:
        """Distance between two lenslet rows, in pitches: the height of a cell, which is one pitch wide."""
        return _ROW_SPACING[self.arrangement]

    @property
    def cell_corners(self) -> Floats:
        """Corners of a cell about its lenslet, in pitches along the lattice, in order around it, (4, xy)."""
        return np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]) * [1.0, self.row_spacing]

    def cell_positions(self, index: NDArray[np.intp]) -> Floats:
        """Positions of cells in pitches, counted in columns and rows (..., xy) from a lenslet at the centre."""
        row = index[..., 1]
        beside = _row_offset(self.arrangement, row) - _row_offset(self.arrangement, np.array(0))
        return np.stack([index[..., 0] + beside, row * self.row_spacing], axis=-1)

    def lenslet_centers_px(self, lenslet_rows: int, lenslet_columns: int) -> Floats:
        """Camera positions of the lenslet centres, (lenslet_row, lenslet_column, xy)."""
        return self.camera_px(lenslet_centers(self.arrangement, lenslet_rows, lenslet_columns))

    def cells_at(
        self, position_px: Floats, lenslet_rows: int, lenslet_columns: int
    ) -> tuple[NDArray[np.intp], Floats, Booleans]:
        """Cells of camera positions (..., xy), also beyond the lattice.

        Returns
        -------
        tuple
            Column and row, (..., xy); the position from the lenslet's centre along the lattice, px, (..., xy); True in
            a cell of the lattice, (...).
        """
        counts, size = np.array([lenslet_columns, lenslet_rows]), np.array([1.0, self.row_spacing])
        in_cells = self.in_pitches(position_px) / size + counts / 2
        in_cells[..., 0] -= _row_offset(self.arrangement, np.floor(in_cells[..., 1]))
        cell = np.floor(in_cells)
        inside = np.all((cell >= 0) & (cell < counts), axis=-1)
        return cell.astype(np.intp), (in_cells - cell - 0.5) * size @ self.pitch_matrix_px, inside


def lenslet_centers(arrangement: Arrangement, lenslet_rows: int, lenslet_columns: int) -> Floats:
    """Lenslet centres in pitches from the lattice's middle, (lenslet_row, lenslet_column, xy)."""
    y, x = np.meshgrid(centered_steps(lenslet_rows), centered_steps(lenslet_columns), indexing="ij")
    x += _row_offset(arrangement, np.arange(lenslet_rows))[:, None]
    return np.stack([x, y * _ROW_SPACING[arrangement]], axis=-1)


def _row_offset(arrangement: Arrangement, row: NDArray[Any]) -> Floats:
    """Distance of lenslet rows (...) from the middle of the lattice along x, in pitches."""
    return np.asarray((2 * (row % 2) - 1) * _ROW_OFFSET[arrangement])


def nominal_lattice(sensor: Sensor, rows: int, columns: int) -> Lattice:
    """The designed lattice, centred on a frame of rows x columns pixels."""
    return Lattice(
        center_x_px=(columns - 1) / 2,
        center_y_px=(rows - 1) / 2,
        pitch_px=sensor.lenslet_pitch_px,
        arrangement=sensor.arrangement,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Field(Checked):
    """Field of view in the front focal plane of the collimator, and its views.

    A square field has Legendre modes, a circular one Zernike modes; `half_width_m` is half the side, or the radius.
    """

    collimator_focal_length_m: Annotated[
        float, Ge(1e-3), Le(20), Doc("Focal length of the collimator behind the source")
    ]
    half_width_m: Annotated[float, Ge(1e-6), Le(0.1), Doc("Half the side of the source, or its radius")]
    shape: Literal["square", "circle"] = "square"
    view_rows: Annotated[int, Ge(1), Le(99)] = STARS
    view_columns: Annotated[int, Ge(1), Le(99)] = STARS
    view_spacing_m: Annotated[float, Ge(1e-9), Le(0.1)] = STAR_SPACING_M
    neglect_propagation: Annotated[bool, Doc("Propagation neglected, as in the paper; never in real light")] = False

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        reach_m = (max(self.view_rows, self.view_columns) - 1) / 2 * self.view_spacing_m
        if reach_m > self.half_width_m * 1.0001:
            yield "view_spacing_m", "places views outside the field's half_width_m"

    @property
    def view_x_m(self) -> Floats:
        """Field position of the view columns, (view_column,)."""
        return centered_steps(self.view_columns) * self.view_spacing_m

    @property
    def view_y_m(self) -> Floats:
        """Field position of the view rows, (view_row,)."""
        return centered_steps(self.view_rows) * self.view_spacing_m

    def contains(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.bool_]:
        """True for normalised positions inside the field, edge included."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        reach = np.hypot(x, y) if self.shape == "circle" else np.maximum(np.abs(x), np.abs(y))
        return np.asarray(reach <= 1 + 1e-9)

    @property
    def outline(self) -> Floats:
        """Eight normalised positions around the field's edge, and its middle, (9, xy)."""
        if self.shape == "square":
            return np.array([(x, y) for y in (-1.0, 0.0, 1.0) for x in (-1.0, 0.0, 1.0)])
        angle = np.arange(8) * math.pi / 4
        return np.concatenate([np.zeros((1, 2)), np.stack([np.cos(angle), np.sin(angle)], axis=-1)])

    def half_width_px(self, sensor: Sensor) -> float:
        """Half the width of the field in a subimage: half_width f / f1, in pixels."""
        magnification = sensor.lenslet_focal_length_m / self.collimator_focal_length_m
        return self.half_width_m * magnification / sensor.pixel_pitch_m


def centered_steps(count: int) -> Floats:
    """`count` integers steps centred on zero: -1, 0, 1 for three; -0.5, 0.5 for two."""
    return np.arange(count, dtype=np.float64) - (count - 1) / 2

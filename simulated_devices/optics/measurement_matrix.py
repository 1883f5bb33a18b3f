"""Measurement matrix of a Shack-Hartmann sensor: a column is the image of an object point.

Feng et al. call a column a SH PSF: the irradiance of the whole camera for one point of the object plane. An object is
a vector of emitting areas, one per point; matrix times object is the camera's irradiance, so that any object behind
the same screen costs one product. With 37 x 37 points and 465 x 465 pixels the matrix takes 1.2 GB: it is kept on disk
as NPY, (point, row, column), dimensionless: m^2 on a pixel per m^2 emitting.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, PointField
from reconstruction.geometry import require
from reconstruction.runtime.renaming import rename
from simulated_devices.optics.forward_model import ForwardModel

_BLOCK_POINTS = 16  # 14 MB of a 465 x 465 camera, and enough rows for an efficient matrix product


def write_matrix(path: Path, model: ForwardModel, position_m: Floats, field: PointField | None = None) -> None:
    """Write the matrix of `model` behind `field` (None: the reference) for points (point, xy) to a new file."""
    require({f"{path} exists: delete it, or choose another name": not path.exists()})
    part = path.with_name(f".{path.name}.part")
    header = {"descr": "<f4", "fortran_order": False, "shape": (len(position_m), *model.camera_shape)}
    try:
        with part.open("wb") as file:  # no memory map: Windows neither renames nor deletes a file that is open
            np.lib.format.write_array_header_1_0(file, header)
            for start in range(0, len(position_m), _BLOCK_POINTS):
                model.point_irradiances(position_m[start : start + _BLOCK_POINTS], field).astype("<f4").tofile(file)
        rename(part, path)
    finally:
        part.unlink(missing_ok=True)


def multiply(path: Path, area_m2: Floats) -> NDArray[np.float32]:
    """Irradiance (row, column), m^2, of an object with that emitting area (m^2) at each point of a written matrix.

    Equals `ForwardModel.irradiance` of these points to rounding; `SourcePoints.area_m2` is such an object.
    """
    matrix = np.load(path, mmap_mode="r")
    points = f"an object must be one emitting area for each of the {len(matrix)} points"
    require({points: area_m2.shape == (len(matrix),)})
    total = np.zeros(matrix.shape[1:])  # float64: the sum over blocks must not add rounding
    for start in range(0, len(matrix), _BLOCK_POINTS):
        block = slice(start, start + _BLOCK_POINTS)
        total += np.tensordot(area_m2[block].astype(np.float32), matrix[block], axes=1)
    return total.astype(np.float32)

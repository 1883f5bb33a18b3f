"""Results as NetCDF-4 files with their origin: written atomically, checked when read."""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from app.bench.bench_files import written_by
from app.bench.config import Bench, write_bench
from app.errors import NOTHING_TO_WRITE, SETTINGS_CHANGED, InputError, RunError
from app.files import atomic_write, check_readable, in_words
from reconstruction.modes.pupil_modes import BASES

if TYPE_CHECKING:
    import xarray as xr

FRAME = "frame"  # dimension of several frames
VIEW, LENSLET = ("view_row", "view_column"), ("lenslet_row", "lenslet_column")
PIECE = 32  # frames
_MARK = b"svwfs-crc32 "  # at the end of a file, beyond what HDF5 reads, with the CRC-32 of all before as eight digits
_DIGITS, _BLOCK = 8, 1 << 20
# Of HDF5: some shares have none, and programs that only look at a file hold one. Files are replaced in one piece, and
# have a checksum.
_NO_LOCK: Mapping[str, Any] = {"locking": False}
_MORE_BYTES = 16 << 10  # of a variable, for its index


def open_results(path: Path | str) -> xr.Dataset:
    """Open a file of results, its arrays when they are used; `InputError` if it has none or is damaged."""
    import xarray as xr

    check_readable(Path(path))
    _check_sum(Path(path))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about files that are odd, which the next lines find
            dataset = xr.open_dataset(path, engine="h5netcdf", driver_kwds=_NO_LOCK)
    except Exception as error:  # damaged files make HDF5 raise anything
        raise InputError(f"{path}: cannot be opened as results: it is not a NetCDF-4 file, or is damaged") from error
    if "wavefront" not in dataset:
        dataset.close()
        raise InputError(f"{path}: holds no results: there is no variable wavefront in it")
    return dataset


@contextmanager
def reading_results(path: Path) -> Iterator[xr.Dataset]:
    """Open results; every error of a damaged file is an `InputError`."""
    with open_results(path) as results:
        try:
            with written_by(path, results.attrs.get("software", "")):
                yield results
        except (InputError, RunError):
            raise
        except Exception as error:
            raise InputError(f"{path}: is damaged: {type(error).__name__}: {in_words(error)}") from error


def _check_sum(path: Path) -> None:
    """Raise `InputError` if a file differs from what was written; files before 0.3 have no checksum."""
    length = path.stat().st_size - len(_MARK) - _DIGITS
    with path.open("rb") as file:
        file.seek(max(length, 0))
        mark, digits = file.read(len(_MARK)), file.read()
        if mark == _MARK and digits != _checksum(path, length):
            raise InputError(f"{path}: is damaged: it is not what was written; reconstruct the frames again")


def _checksum(path: Path, length: int) -> bytes:
    """CRC-32 of the first bytes of a file, in hexadecimal digits."""
    crc = 0
    with path.open("rb") as file:
        for begin in range(0, length, _BLOCK):
            crc = zlib.crc32(file.read(min(_BLOCK, length - begin)), crc)
    return b"%08x" % crc


def write_results(path: Path, dataset: xr.Dataset, *, bench: Bench, inputs: Mapping[str, str]) -> None:
    """Write a dataset with bench, software version and names of the inputs as attributes (atomic)."""
    write_pieces(path, [dataset], bench=bench, inputs=inputs)


def write_pieces(path: Path, pieces: Iterable[xr.Dataset], *, bench: Bench, inputs: Mapping[str, str]) -> None:
    """Write results of frames, two pieces in memory at a time; `InputError` if their settings changed."""
    import xarray as xr

    is_first = True
    with atomic_write(path) as temporary:
        for piece, following in pairwise(chain(pieces, [xr.Dataset()])):
            if is_first:
                temporary.write_bytes(_netcdf(piece, bench, inputs, grows=bool(following)))
            else:
                _append(temporary, piece)
            is_first = False
        if is_first:
            raise RunError(f"{path}: {NOTHING_TO_WRITE}")
        checksum = _checksum(temporary, temporary.stat().st_size)
        with temporary.open("ab") as file:
            file.write(_MARK + checksum)


def _netcdf(piece: xr.Dataset, bench: Bench, inputs: Mapping[str, str], *, grows: bool) -> memoryview:
    """Return a file's contents, made in memory as HDF5 crashes on a full disk; one that `grows` opens slowly."""
    origin = {"software": f"svwfs {version('svwfs')}", "bench": write_bench(bench), **inputs}
    piece = with_mode_names(piece, bench)
    if bench.linearity is not None:
        origin["linearity"] = f"corrected: {bench.linearity.sentence}"
    # names of files need not be text
    origin = {name: text.encode(errors="replace").decode() for name, text in origin.items()}
    attributes = {"title": "Space-variant wavefront", **_geometry(bench)} | piece.attrs | origin
    of_frames = {name: each for name, each in piece.variables.items() if grows and FRAME in each.dims}
    return piece.assign_attrs(attributes).to_netcdf(
        engine="h5netcdf",
        unlimited_dims=[FRAME] if grows else [],
        encoding={name: {"chunksizes": (PIECE, *variable.shape[1:])} for name, variable in of_frames.items()},
    )


def with_mode_names(results: xr.Dataset, bench: Bench) -> xr.Dataset:
    """Return results with the names of their pupil modes, if the basis has names."""
    basis = BASES.get(bench.reconstruction.basis)
    if basis is None or "pupil_mode" not in results.dims:
        return results
    names = list(basis.names(results.sizes["pupil_mode"]))
    return results.assign_coords(pupil_mode_name=("pupil_mode", names, {"long_name": basis.about}))


def _geometry(bench: Bench) -> dict[str, Any]:
    """Attributes that say axes, lattice and pupil."""
    lattice, pupil, circle = bench.lattice, bench.sensor.pupil, bench.sensor.circle
    of_lattice: dict[str, Any] = {}
    if lattice is not None:
        center_px = [lattice.center_x_px, lattice.center_y_px]
        of_lattice = {"lattice_rotation_rad": lattice.rotation_rad, "lattice_center_px": center_px}
    return {
        "axes": "x runs along the rows of the lattice, y along its columns: the camera's axes (x to the right, y down),"
        " turned by lattice_rotation_rad, positive from x to y",
        **of_lattice,
        "pupil": pupil.shape if pupil.is_bounded else "all lenslets",
        "pupil_center_m": [circle.center_x_m, circle.center_y_m],
        "pupil_radius_m": circle.radius_m,
        "pupil_obscuration": circle.obscuration,
    }


def _append(path: Path, piece: xr.Dataset) -> None:
    """Append frames to a file, first as zeros: on a disk that becomes full, HDF5 would crash."""
    import h5netcdf

    of_frames = {name: variable for name, variable in piece.variables.items() if FRAME in variable.dims}
    with path.open("ab") as room:
        for variable in of_frames.values():
            chunks = -(-variable.shape[0] // PIECE) + 1
            room.write(bytes(chunks * PIECE * math.prod(variable.shape[1:]) * variable.dtype.itemsize + _MORE_BYTES))
    with h5netcdf.File(path, "r+", **_NO_LOCK) as file:
        first = file.dimensions[FRAME].size
        sizes = {name: dimension.size for name, dimension in file.dimensions.items() if name != FRAME}
        require_alike(sizes, {name: size for name, size in piece.sizes.items() if name != FRAME})
        file.resize_dimension(FRAME, first + piece.sizes[FRAME])
        for name, variable in of_frames.items():
            stored = file.variables[name]
            stored[first:] = variable.values.astype(stored.dtype)


def require_alike(sizes: Mapping[Hashable, int], others: Mapping[Hashable, int]) -> None:
    """Raise `InputError` if the sizes of the dimensions differ."""
    if dict(sizes) != dict(others):
        raise InputError(SETTINGS_CHANGED)


Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, Any]]  # dimensions, values, attributes


def about(units: str, long_name: str) -> dict[str, str]:
    """Attributes of a variable."""
    return {"units": units, "long_name": long_name}

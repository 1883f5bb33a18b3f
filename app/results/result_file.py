"""Results as NetCDF-4 files with their origin: written atomically, checked when read."""

from __future__ import annotations

import io
import os
import warnings
import zlib
from collections.abc import Hashable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from app.bench.bench_files import written_by
from app.bench.config import Bench, write_bench
from app.errors import NOTHING_TO_WRITE, SETTINGS_CHANGED, InputError, RunError
from app.files import atomic_write, check_readable, in_words

if TYPE_CHECKING:
    import h5netcdf
    import xarray as xr

FRAME = "frame"  # dimension of several frames
VIEW, LENSLET = ("view_row", "view_column"), ("lenslet_row", "lenslet_column")
PIECE = 32  # frames
_CHECKSUMS = "crc32"  # group with an attribute for each variable, which xarray does not copy to changed files
_BENCH = "bench attribute"  # its checksum's name, which no variable has
_LARGEST_PX = 1e6  # of a displacement


def open_results(path: Path | str) -> xr.Dataset:
    """Open a file of results, its arrays when they are used; `InputError` if it has none or is damaged."""
    import xarray as xr

    check_readable(Path(path))
    try:
        _check_sums(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about files that are odd, which the next lines find
            dataset = xr.open_dataset(path, engine="h5netcdf")
    except InputError:
        raise
    except Exception as error:  # damaged files make HDF5 raise anything
        raise InputError(f"{path}: cannot be opened as results: it is not a NetCDF-4 file, or is damaged") from error
    if "wavefront" not in dataset:
        dataset.close()
        raise InputError(f"{path}: holds no results: there is no variable wavefront in it")
    return dataset


@contextmanager
def reading_results(path: Path) -> Iterator[xr.Dataset]:
    """Open results with plausible displacements; every error of a damaged file is an `InputError`."""
    with open_results(path) as results:
        try:
            _require_sound(path, results)
            with written_by(path, results.attrs.get("software", "")):
                yield results
        except (InputError, RunError):
            raise
        except Exception as error:
            raise InputError(f"{path}: is damaged: {type(error).__name__}: {in_words(error)}") from error


def _require_sound(path: Path, results: xr.Dataset) -> None:
    """Raise `InputError` for a frame without valid lenslets, or with an impossible displacement."""
    if "valid" in results and "displacement" in results:
        valid = results["valid"].astype(bool)
        if not valid.any(LENSLET).all():
            raise InputError(f"{path}: is damaged: it has a frame without a valid lenslet")
        if not (~valid | (abs(results["displacement"]) < _LARGEST_PX)).all():
            raise InputError(f"{path}: is damaged: a valid lenslet has a displacement that none can have")


def _check_sums(path: Path | str) -> None:
    """Raise `InputError` if a variable differs from what was written; files before 0.3 have no checksums."""
    import h5py

    with h5py.File(path, "r") as file:
        file.attrs.get("_nc3_strict")  # if that fails, h5netcdf fails with a traceback from its destructor, too
        if file.visititems(_has_odd_scales):
            raise InputError(f"{path}: is damaged: its variables are not tied to dimensions as in a NetCDF-4 file")
        for name, written in file[_CHECKSUMS].attrs.items() if _CHECKSUMS in file else ():
            if name == _BENCH:
                if _checksum(np.array(file.attrs["bench"], object)) != written:
                    raise InputError(f"{path}: is damaged: its bench is not what was written")
                continue
            variable, found = file[name], 0
            for first in range(0, variable.shape[0], PIECE) if variable.ndim else (None,):
                found = _checksum(variable[... if first is None else slice(first, first + PIECE)], found)
            if found != written:
                raise InputError(f"{path}: is damaged: {name} is not what was written; reconstruct the frames again")


def _has_odd_scales(_: str, stored: object) -> bool | None:
    """Return True for a dataset whose links to dimensions would crash HDF5; None, to go on, if not.

    HDF5 takes the links for one list of references for each dimension, whatever they are, and aborts the process.
    """
    import h5py

    if not isinstance(stored, h5py.Dataset):
        return None
    reference = h5py.h5t.STD_REF_OBJ
    if "DIMENSION_LIST" in stored.attrs:
        links = stored.attrs.get_id("DIMENSION_LIST")
        kind = links.get_type()
        if not isinstance(kind, h5py.h5t.TypeVlenID) or kind.get_super() != reference or links.shape != (stored.ndim,):
            return True
    if "REFERENCE_LIST" in stored.attrs:
        kind = stored.attrs.get_id("REFERENCE_LIST").get_type()
        if not isinstance(kind, h5py.h5t.TypeCompoundID) or kind.get_member_type(0) != reference:
            return True
    return None


def _checksum(values: Any, before: int = 0) -> int:
    """Return the CRC-32 of values that follow others with the checksum `before`."""
    values = np.asarray(values)
    if values.dtype.kind in "biuf":
        return zlib.crc32(values.tobytes(), before)
    texts = (each.encode() if isinstance(each, str) else each for each in values.flat)  # they are read as bytes
    return zlib.crc32(b"".join(text + b"\0" for text in texts), before)


def write_results(path: Path, dataset: xr.Dataset, *, bench: Bench, inputs: Mapping[str, str]) -> None:
    """Write a dataset with bench, software version and names of the inputs as attributes (atomic)."""
    write_pieces(path, [dataset], bench=bench, inputs=inputs)


def write_pieces(path: Path, pieces: Iterable[xr.Dataset], *, bench: Bench, inputs: Mapping[str, str]) -> None:
    """Write results of many frames as `write_results` does, two pieces in memory at a time.

    `InputError` if a piece has another shape than the first, because the settings changed between them.
    """
    import h5netcdf
    import xarray as xr

    count, sums = 0, dict[Hashable, int]()
    with atomic_write(path) as temporary:
        for piece, following in pairwise(chain(pieces, [xr.Dataset()])):
            if not count:
                temporary.write_bytes(_netcdf(piece, bench, inputs, grows=bool(following)))
                _verify(temporary, path, piece.sizes.get(FRAME, 1))
            with HdfFile(temporary) as writable, h5netcdf.File(writable, "r+") as file:
                if count:
                    _append(file, piece)
                _add_sums(file, piece, sums)
            count += piece.sizes.get(FRAME, 1)
            _verify(temporary, path, count)
        if not count:
            raise RunError(f"{path}: {NOTHING_TO_WRITE}")


def _add_sums(file: h5netcdf.File, piece: xr.Dataset, sums: dict[Hashable, int]) -> None:
    """Update the checksums of the variables, as they are stored, by those of a piece."""
    group = file.groups[_CHECKSUMS] if sums else file.create_group(_CHECKSUMS)
    if not sums:
        group.attrs[_BENCH] = np.uint32(_checksum(np.array(file.attrs["bench"], object)))
    for name, variable in piece.variables.items():
        if name not in sums or FRAME in variable.dims:
            stored = file.variables[name]
            values = variable.values if variable.dtype.kind in "UO" else variable.values.astype(stored.dtype)
            sums[name] = _checksum(values, sums.get(name, 0))
            group.attrs[str(name)] = np.uint32(sums[name])


def _netcdf(piece: xr.Dataset, bench: Bench, inputs: Mapping[str, str], *, grows: bool) -> memoryview:
    """Return the contents of a file. HDF5 crashes on a full disk, so it writes into memory.

    Only a file that `grows` has an unlimited dimension: h5netcdf opens such a file six times slower.
    """
    origin = {"software": f"svwfs {version('svwfs')}", "bench": write_bench(bench), **inputs}
    if bench.linearity is not None:
        origin["linearity"] = f"corrected: {bench.linearity.sentence}"
    # names of files need not be text
    origin = {name: text.encode(errors="replace").decode() for name, text in origin.items()}
    return piece.assign_attrs(**{"title": "Space-variant wavefront"} | piece.attrs | origin).to_netcdf(
        engine="h5netcdf", unlimited_dims=[FRAME] if grows else []
    )


def _verify(written: Path, path: Path, frames: int) -> None:
    import h5netcdf

    try:
        with h5netcdf.File(written, "r") as file:
            found = file.dimensions[FRAME].size if FRAME in file.dimensions else 1
    except OSError as error:
        raise RunError(f"{path}: cannot be read again: {in_words(error)}") from error
    if found != frames:
        raise RunError(f"{path}: only {found} of {frames} frames were written")


def _append(file: h5netcdf.File, piece: xr.Dataset) -> None:
    first = file.dimensions[FRAME].size
    sizes = {name: dimension.size for name, dimension in file.dimensions.items() if name != FRAME}
    require_alike(sizes, {name: size for name, size in piece.sizes.items() if name != FRAME})
    file.resize_dimension(FRAME, first + piece.sizes[FRAME])
    for name, variable in piece.variables.items():
        if FRAME in variable.dims:
            stored = file.variables[name]
            stored[first:] = variable.values.astype(stored.dtype)


def require_alike(sizes: Mapping[Hashable, int], others: Mapping[Hashable, int]) -> None:
    """Raise `InputError` if the sizes of the dimensions differ."""
    if dict(sizes) != dict(others):
        raise InputError(SETTINGS_CHANGED)


class HdfFile(io.RawIOBase):
    """An existing file opened for changes, whose writes never fail for HDF5.

    After the first failed write, for example on a full disk, what is written stays in memory, where HDF5 finds it
    again. `close` raises the error.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("r+b", buffering=0)
        self._end = os.fstat(self._file.fileno()).st_size
        self._unwritten: list[tuple[int, bytes]] = []
        self._error: OSError | None = None

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Move to a position; the end is that of all that was written."""
        return self._file.seek(self._end + offset) if whence == os.SEEK_END else self._file.seek(offset, whence)

    def write(self, data: Any, /) -> int:
        """Write all bytes, to the disk or else to the memory."""
        left, begin = memoryview(data).cast("B"), self.tell()
        if self._error is None:
            try:
                rest = left
                while rest:
                    rest = rest[self._file.write(rest) :]
            except OSError as error:
                self._error = error
        if self._error is not None:
            self._unwritten.append((begin, bytes(left)))
        self._end = max(self._end, self.seek(begin + len(left)))
        return len(left)

    def readinto(self, buffer: Any, /) -> int:
        """Fill the buffer as far as the file goes."""
        target, begin = memoryview(buffer).cast("B"), self.tell()
        length = max(0, min(len(target), self._end - begin))
        stored = self._file.read(length).ljust(length, b"\0")
        target[:length] = stored
        for offset, data in self._unwritten:
            first, last = max(offset, begin), min(offset + len(data), begin + length)
            if first < last:
                target[first - begin : last - begin] = data[first - offset : last - offset]
        self.seek(begin + length)
        return length

    def truncate(self, size: int | None = None, /) -> int:
        """Set the length."""
        self._end = self.tell() if size is None else size
        if self._error is None:
            try:
                self._file.truncate(self._end)
            except OSError as error:
                self._error = error
        return self._end

    def close(self) -> None:
        """Close the file; `OSError` if anything could not be written."""
        if not self.closed:
            self._file.close()
            super().close()
            if self._error is not None:
                raise self._error


Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, Any]]  # dimensions, values, attributes


def about(units: str, long_name: str) -> dict[str, str]:
    """Attributes of a variable."""
    return {"units": units, "long_name": long_name}

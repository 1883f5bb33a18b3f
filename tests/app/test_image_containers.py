"""Images in files that hold several arrays or frames: HDF5, MAT, NPZ, stacks and packed FITS."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from numpy.typing import NDArray

from app.errors import InputError
from app.images import name_of, place_of, read_image

STACK = np.random.default_rng(3).integers(0, 4096, (5, 6, 9)).astype(np.uint16)  # frame, row, column
IMAGE = STACK[0]


def write_hdf5(path: Path, arrays: dict[str, NDArray[np.generic]], *, in_matlab: bool = False) -> None:
    """Write datasets; MATLAB has a block of text before them, and the axes the other way round."""
    with h5py.File(path, "w", userblock_size=512 if in_matlab else 0) as file:
        for name, array in arrays.items():
            file[name] = array.T if in_matlab else array
    if in_matlab:
        with path.open("r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" "))


def fits(values: NDArray[np.uint16]) -> bytes:
    """A FITS file of unsigned 16-bit numbers, made by hand."""
    axes = values.shape[::-1]
    cards = {"SIMPLE": "T", "BITPIX": 16, "NAXIS": len(axes), **{f"NAXIS{i}": n for i, n in enumerate(axes, 1)}}
    lines = [f"{name:8}= {value!s:>20}" for name, value in {**cards, "BZERO": 32768}.items()] + ["END"]
    header = "".join(f"{line:80}" for line in lines).encode()
    data = (values.astype(np.int32) - 32768).astype(">i2").tobytes()
    return header.ljust(2880) + data.ljust(-(-len(data) // 2880) * 2880, b"\0")


WRITERS: dict[str, Callable[[Path, NDArray[np.uint16]], object]] = {
    "a.h5": lambda path, array: write_hdf5(path, {"group/frames": array, "exposure_s": np.array(0.1)}),
    "a.npz": lambda path, array: np.savez(path, frames=array, names=np.array(["a"]), notes=np.array({})),
    "a.npy": np.save,
    "a.tif": lambda path, array: tifffile.imwrite(path, array, photometric="minisblack"),
    "imagej.tif": lambda path, array: tifffile.imwrite(path, array, imagej=True),
    "a.fits": lambda path, array: path.write_bytes(fits(array)),
    "a.fits.gz": lambda path, array: path.write_bytes(gzip.compress(fits(array))),
    "a.mat": lambda path, array: scipy.io.savemat(path, {"frames": np.moveaxis(array, 0, -1), "gain": 3.0}),
    "new.mat": lambda path, array: write_hdf5(path, {"frames": np.moveaxis(array, 0, -1)}, in_matlab=True),
    "old.mat": lambda path, array: scipy.io.savemat(path, {"frames": array[0].astype(float)}, format="4"),
}


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "old.mat"])
def test_frame_of_a_stack_is_chosen_by_its_index(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    WRITERS[name](path, STACK)
    for index in (0, 3, -1):
        image = read_image(Path(f"{path}[{index}]"))
        np.testing.assert_array_equal(image, STACK[index])
        assert image.dtype == np.uint16
    with pytest.raises(InputError, match=r"it has no image 5: they are counted from 0, their number is 5"):
        read_image(Path(f"{path}[5]"))
    with pytest.raises(InputError, match=r"choose one, as .*\[0\]"):
        read_image(path)


@pytest.mark.parametrize("name", WRITERS)
def test_single_image_is_read_from_every_container(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    WRITERS[name](path, STACK[:1])
    np.testing.assert_array_equal(read_image(path), IMAGE)
    if name != "old.mat":
        np.testing.assert_array_equal(read_image(Path(f"{path}[0]")), IMAGE)


def test_array_is_chosen_by_its_name(tmp_path: Path) -> None:
    many = {"data/dark": STACK[4], "data/frames": STACK, "data/mask": STACK[1] > 7}
    write_hdf5(tmp_path / "a.h5", many)
    np.testing.assert_array_equal(read_image(Path(f"{tmp_path}/a.h5:/data/dark")), STACK[4])
    np.testing.assert_array_equal(read_image(Path(f"{tmp_path}/a.h5:data/frames[2]")), STACK[2])
    scipy.io.savemat(tmp_path / "a.mat", {"img": IMAGE, "camera": {"dark": STACK[1]}})
    np.testing.assert_array_equal(read_image(Path(f"{tmp_path}/a.mat:img")), IMAGE)
    np.testing.assert_array_equal(read_image(Path(f"{tmp_path}/a.mat:camera/dark")), STACK[1])
    with pytest.raises(InputError) as refusal:
        read_image(tmp_path / "a.h5")
    listed = "it holds data/frames (5 x 6 x 9), data/dark (6 x 9): name one, as a.h5:data/frames"
    assert str(refusal.value).endswith(listed)
    with pytest.raises(InputError, match="it has no array data/Dark; it holds data/frames"):
        read_image(Path(f"{tmp_path}/a.h5:/data/Dark"))
    assert name_of(Path(f"{tmp_path}/a.h5:/data/frames[2]")) == "a.h5:/data/frames[2]"
    assert place_of(Path(f"{tmp_path}/a.h5:/data/frames[2]")) == (tmp_path / "a.h5", "/data/frames", 2)


def test_file_with_such_a_name_is_itself_read(tmp_path: Path) -> None:
    for name in ("a[0].npy", "a:b.npy"):
        np.save(tmp_path / name, IMAGE)
        np.testing.assert_array_equal(read_image(tmp_path / name), IMAGE)


@pytest.mark.parametrize("shape", [(1, 6, 9), (6, 9, 1), (1, 6, 9, 1)])
def test_axes_of_length_one_are_dropped(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "a.npy", IMAGE.reshape(shape))
    tifffile.imwrite(tmp_path / "a.tif", IMAGE.reshape(shape), photometric="minisblack")
    for name in ("a.npy", "a.tif"):
        np.testing.assert_array_equal(read_image(tmp_path / name), IMAGE)


def test_three_frames_of_a_stack_are_no_channels(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", STACK[:3], photometric="rgb", planarconfig="separate")  # as by default
    for index in range(3):
        np.testing.assert_array_equal(read_image(Path(f"{tmp_path}/a.tif[{index}]")), STACK[index])
    with pytest.raises(InputError, match="their number is 3"):
        read_image(Path(f"{tmp_path}/a.tif[3]"))


def test_pages_of_other_sizes_are_chosen_by_their_index(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "two.tif") as file:
        file.write(IMAGE)
        file.write(STACK[1, ::2], subfiletype=0)
    np.testing.assert_array_equal(read_image(Path(f"{tmp_path}/two.tif[1]")), STACK[1, ::2])


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut.h5": (lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(50)), "cannot be read as"),
    "cut.mat": (lambda path: path.write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200)), "cannot be read as"),
    "cut.npz": (lambda path: path.write_bytes(b"PK\x03\x04" + bytes(50)), "cannot be read as"),
    "cut.fits.gz": (lambda path: path.write_bytes(gzip.compress(fits(IMAGE))[:60]), "cannot be read as"),
    "no.mat": (lambda path: path.write_bytes(b"nothing of MATLAB"), "cannot be read as"),
    "empty.h5": (lambda path: write_hdf5(path, {}), "it holds no image"),
    "numbers.npz": (lambda path: np.savez(path, a=np.arange(5)), "it holds no image"),
    "objects.npz": (lambda path: np.savez(path, a=np.array([{}, None])), "it holds no image"),
    "packed.gz": (lambda path: path.write_bytes(gzip.compress(b"text")), "corrupt FITS file"),
    "a.csv": (lambda path: path.write_text("1,2,3\n4,5,6\n"), "such as text or JPEG; save the frame as TIFF"),
    "a.gif": (lambda path: path.write_bytes(b"GIF89a" + bytes(range(200))), "save the frame as TIFF"),
    "a.tif:x": (lambda path: tifffile.imwrite(path, IMAGE), "only HDF5, MAT and NPZ hold arrays with names"),
    "a.png[1]": (lambda path: path.write_bytes(b"BM" + bytes(60)), "cannot be read as"),
    "one.tif[1]": (lambda path: tifffile.imwrite(path, IMAGE), "their number is 1"),
    "nothing.npy": (lambda path: np.save(path, STACK[:0]), "holds 0 x"),
    "many.npy[9]": (lambda path: np.save(path, STACK), "their number is 5"),
}


@pytest.mark.parametrize("name", BAD)
def test_unusable_container_is_refused_with_a_remedy(tmp_path: Path, name: str) -> None:
    write, sentence = BAD[name]
    write(tmp_path / name.split("[", maxsplit=1)[0].split(":", maxsplit=1)[0])
    with pytest.raises(InputError, match=sentence) as refusal:
        read_image(tmp_path / name)
    assert "\n" not in str(refusal.value)


def test_missing_file_is_named_with_its_parts(tmp_path: Path) -> None:
    for name in ("no.h5:/data", "no.tif[3]", "no.h5:/data[3]"):
        with pytest.raises(InputError, match="no such file"):
            read_image(tmp_path / name)


def test_huge_dataset_is_not_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "huge.h5", "w") as file:
        file.create_dataset("a", (10, 2**15, 2**14), np.uint8, chunks=(1, 1024, 1024))
    with pytest.raises(InputError, match="are too many"):
        read_image(Path(f"{tmp_path}/huge.h5[1]"))

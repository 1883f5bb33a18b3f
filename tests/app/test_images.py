"""Image files: what is read from each format, and what is refused."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from astropy.io import fits as astropy_fits
from PIL import Image

from app.errors import InputError
from app.images import read_image, write_image

IMAGE = np.arange(12, dtype=np.uint16).reshape(3, 4)


def test_written_images_are_read_back(tmp_path: Path) -> None:
    write_image(tmp_path / "image.tif", IMAGE)
    np.save(tmp_path / "image.npy", IMAGE)
    np.testing.assert_array_equal(read_image(tmp_path / "image.tif"), IMAGE)
    np.testing.assert_array_equal(read_image(tmp_path / "image.npy"), IMAGE)


def test_unusable_image_error_names_file(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "colour.tif", np.eye(8, dtype=np.uint8)[..., None] * [3, 4, 5], photometric="rgb")
    tifffile.imwrite(tmp_path / "stack.tif", np.zeros((5, 8, 8), np.uint16), photometric="minisblack")
    np.save(tmp_path / "empty.npy", np.zeros((0, 4)))
    np.save(tmp_path / "complex.npy", np.zeros((4, 4), complex))
    np.save(tmp_path / "objects.npy", np.array([{}, None]), allow_pickle=True)
    (tmp_path / "text.tif").write_text("no image")
    (tmp_path / "nothing.tif").touch()
    whole = tmp_path / "whole.tif"
    write_image(whole, np.zeros((200, 200), np.uint16))
    (tmp_path / "cut.tif").write_bytes(whole.read_bytes()[:5000])
    names = ["colour.tif", "stack.tif", "empty.npy", "complex.npy", "objects.npy", "text.tif", "nothing.tif", "cut.tif"]
    for name in [*names, "missing.tif", "."]:
        with pytest.raises(InputError) as fault:
            read_image(tmp_path / name)
        assert str(tmp_path / name) in str(fault.value)
        assert "\n" not in str(fault.value)


@pytest.mark.parametrize(
    ("orientation", "first", "second", "below"),  # where TIFF 6.0 has stored pixels (0, 0), (0, 1) and (1, 0)
    [
        *((1, (0, 0), (0, 1), (1, 0)), (2, (0, 3), (0, 2), (1, 3)), (3, (2, 3), (2, 2), (1, 3))),
        *((4, (2, 0), (2, 1), (1, 0)), (5, (0, 0), (1, 0), (0, 1)), (6, (0, 2), (1, 2), (0, 1))),
        *((7, (3, 2), (2, 2), (3, 1)), (8, (3, 0), (2, 0), (3, 1))),
    ],
)
def test_image_is_turned_as_its_tag_says(
    tmp_path: Path, orientation: int, first: tuple[int, int], second: tuple[int, int], below: tuple[int, int]
) -> None:
    tifffile.imwrite(tmp_path / "turned.tif", IMAGE, extratags=[(274, 3, 1, orientation, True)])
    image = read_image(tmp_path / "turned.tif")
    assert image.shape == ((3, 4) if orientation < 5 else (4, 3))
    assert [image[at] for at in (first, second, below)] == [IMAGE[0, 0], IMAGE[0, 1], IMAGE[1, 0]]


def test_only_image_of_a_file_is_read(tmp_path: Path) -> None:
    """Pages of other sizes or types are other images, a reduced one is a preview."""
    with tifffile.TiffWriter(tmp_path / "preview.tif") as file:
        file.write(IMAGE)
        file.write(IMAGE[::2, ::2], subfiletype=1)
    np.testing.assert_array_equal(read_image(tmp_path / "preview.tif"), IMAGE)
    with tifffile.TiffWriter(tmp_path / "two.tif") as file:
        file.write(IMAGE)
        file.write(IMAGE[::2, ::2])
    with pytest.raises(InputError, match=r"holds 2 images; choose one, as two.tif\[0\]"):
        read_image(tmp_path / "two.tif")


def test_file_that_leaves_the_compression_out_is_read(tmp_path: Path) -> None:
    """As ImageJ writes it: tag 259 is optional. Here another number hides it, which no reader knows."""
    tifffile.imwrite(tmp_path / "frame.tif", IMAGE, metadata=None, byteorder="<")
    content = (tmp_path / "frame.tif").read_bytes()
    tag = (259).to_bytes(2, "little") + (3).to_bytes(2, "little")
    assert content.count(tag) == 1
    (tmp_path / "frame.tif").write_bytes(content.replace(tag, (65000).to_bytes(2, "little") + tag[2:]))
    with tifffile.TiffFile(tmp_path / "frame.tif") as file:
        assert 259 not in file.pages.first.tags
    np.testing.assert_array_equal(read_image(tmp_path / "frame.tif"), IMAGE)


@pytest.mark.parametrize("most", [255, 4095, 65535])
def test_pgm_of_text_is_read(tmp_path: Path, most: int) -> None:
    expected = np.random.default_rng(1).integers(0, most + 1, (5, 7))
    numbers = "\n".join(" ".join(map(str, row)) for row in expected)
    (tmp_path / "frame.pgm").write_text(f"P2\n# a comment\n7 5\n{most}\n{numbers}\n")
    np.testing.assert_array_equal(read_image(tmp_path / "frame.pgm"), expected)


def test_negative_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "negative.tif", IMAGE, photometric="miniswhite")
    with pytest.raises(InputError, match="a negative, in which 0 is white"):
        read_image(tmp_path / "negative.tif")


def test_planes_that_only_a_text_claims_are_not_made(tmp_path: Path) -> None:
    pixels = 'DimensionOrder="XYZCT" Type="uint16" SizeX="4" SizeY="3" SizeZ="1" SizeC="1" SizeT="1000000"'
    text = f'<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0"><Pixels {pixels}'
    text += ' ID="Pixels:0"><TiffData/></Pixels></Image></OME>'
    tifffile.imwrite(tmp_path / "ome.tif", IMAGE, description=text, metadata=None)
    np.testing.assert_array_equal(read_image(tmp_path / "ome.tif"), IMAGE)


@pytest.mark.slow
def test_image_files_that_lie_are_refused(tmp_path: Path) -> None:
    header = np.lib.format.MAGIC_PREFIX + b"\x01\x00v\x00"
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (999999, 999999), }"
    (tmp_path / "bomb.npy").write_bytes(header + text.ljust(117) + b"\n" + bytes(100))
    tifffile.imwrite(tmp_path / "bomb.tif", np.zeros((2**15, 2**14), np.uint8), compression="deflate")
    for name, sentence in {"bomb.npy": "cannot be read", "bomb.tif": "are too many"}.items():
        with pytest.raises(InputError, match=sentence):
            read_image(tmp_path / name)


def fits(*units: tuple[dict[str, object], bytes]) -> bytes:
    """Header and data units of a FITS file, padded to blocks of 2880 bytes."""
    file = b""
    for header, data in units:
        cards = [f"{name:8}= {value!s:>20} / a comment's words" for name, value in header.items()]
        text = "".join(f"{card:80}" for card in [*cards, "COMMENT = 5 / no value", "END"])
        file += text.encode().ljust(-(-len(text) // 2880) * 2880) + data.ljust(-(-len(data) // 2880) * 2880, b"\0")
    return file


def primary(bitpix: int = 16, **more: object) -> dict[str, object]:
    return {"SIMPLE": "T", "BITPIX": bitpix, "NAXIS": 2, "NAXIS1": 4, "NAXIS2": 3, **more}


EMPTY = {"SIMPLE": "T", "BITPIX": 8, "NAXIS": 0, "EXTEND": "T"}, b""
TABLE = {"XTENSION": "'BINTABLE'", "BITPIX": 8, "NAXIS": 2, "NAXIS1": 7, "NAXIS2": 2, "PCOUNT": 3, "GCOUNT": 1}
EXTENSION = {"XTENSION": "'IMAGE   '", "BITPIX": 32, "NAXIS": 2, "NAXIS1": 4, "NAXIS2": 3, "PCOUNT": 0, "GCOUNT": 1}
SHORTS, LONGS = IMAGE.astype(">i2").tobytes(), IMAGE.astype(">i4").tobytes()
TOP = 2**15
FITS: dict[str, tuple[bytes, np.ndarray]] = {
    "short": (fits((primary(), SHORTS)), IMAGE.astype(np.int16)),
    "float": (fits((primary(-32), (IMAGE - 0.5).astype(">f4").tobytes())), (IMAGE - 0.5).astype(np.float32)),
    "unsigned": (fits((primary(BZERO=TOP), (IMAGE - TOP).astype(">i2").tobytes())), IMAGE),
    "scaled": (fits((primary(BSCALE="2.5D0", BZERO=-100.0), SHORTS)), (IMAGE * 2.5 - 100).astype(np.float32)),
    "plane of a cube": (fits((primary(NAXIS=3, NAXIS3=1), SHORTS)), IMAGE.astype(np.int16)),
    "extension": (fits(EMPTY, (TABLE, bytes(17)), (EXTENSION, LONGS)), IMAGE.astype(np.int32)),
    "blank": (fits((primary(BLANK=7), SHORTS)), np.where(IMAGE == 7, np.nan, IMAGE).astype(np.float32)),
    "blank and unsigned": (
        fits((primary(BZERO=TOP, BLANK=7 - TOP), (IMAGE - TOP).astype(">i2").tobytes())),
        np.where(IMAGE == 7, np.nan, IMAGE),
    ),
    "records behind it": (fits((primary(), SHORTS)) + bytes(2880), IMAGE.astype(np.int16)),
}


@pytest.mark.parametrize("case", FITS)
def test_fits_images_are_read(tmp_path: Path, case: str) -> None:
    content, expected = FITS[case]
    (tmp_path / "frame.fit").write_bytes(content)
    image = read_image(tmp_path / "frame.fit")
    np.testing.assert_array_equal(image, expected)
    assert image.dtype == expected.dtype
    assert image.dtype.isnative


def test_compressed_fits_image_is_read(tmp_path: Path) -> None:
    """Observatories keep frames so (funpack is not needed)."""
    astropy_fits.CompImageHDU(IMAGE.astype(np.int16)).writeto(tmp_path / "frame.fits.fz")
    np.testing.assert_array_equal(read_image(tmp_path / "frame.fits.fz"), IMAGE)


BAD_FITS = {
    "it holds 2 images; choose one": fits((primary(), SHORTS), (EXTENSION, LONGS)),
    "it holds 0 images": fits(EMPTY),
    "2 x 2 x 6; one grey image": fits((primary(NAXIS=3, NAXIS1=6, NAXIS2=2, NAXIS3=2), 2 * SHORTS)),
    "header is damaged: \"Keyword 'ZBITPIX' not found": fits(EMPTY, ({**TABLE, "ZIMAGE": "T"}, bytes(17))),
    "File may have been truncated": fits((primary(NAXIS2=300_000), SHORTS)),
    "Empty or corrupt FITS file": fits((primary(), b""))[:500],
    "header is damaged: 17": fits((primary(17), SHORTS)),
    "Header missing END card": fits(({"SIMPLE": "T", "BITPIX": 16}, SHORTS)),
    "header is damaged: ufunc": fits((primary(BZERO="'abc'"), SHORTS)),
    "cannot be read as": fits((primary(NAXIS1=-4), SHORTS)),
}


@pytest.mark.parametrize("sentence", BAD_FITS)
def test_unusable_fits_is_refused(tmp_path: Path, sentence: str) -> None:
    (tmp_path / "frame.fits").write_bytes(BAD_FITS[sentence])
    with pytest.raises(InputError, match=sentence):
        read_image(tmp_path / "frame.fits")


@pytest.mark.parametrize("name", ["grey.png", "GREY.BMP", "grey.pgm", "grey_by_name.tif"])
def test_pictures_of_8_bits_are_read(tmp_path: Path, name: str) -> None:
    """The content tells the format, not the name."""
    kind = {"GREY.BMP": "BMP", "grey.pgm": "PPM"}.get(name, "PNG")
    Image.fromarray(IMAGE.astype(np.uint8)).save(tmp_path / name, format=kind)
    image = read_image(tmp_path / name)
    np.testing.assert_array_equal(image, IMAGE)
    assert image.dtype == np.uint8


def test_png_of_16_bits_keeps_them(tmp_path: Path) -> None:
    Image.fromarray(IMAGE * 5003).save(tmp_path / "deep.png")
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), IMAGE * 5003)


def test_grey_image_saved_in_colours_is_grey(tmp_path: Path) -> None:
    grey = IMAGE.astype(np.uint8)
    opaque = np.full((3, 4), 255, np.uint8)
    Image.fromarray(np.stack([grey] * 3, axis=-1)).save(tmp_path / "rgb.png")
    Image.fromarray(np.stack([*[grey] * 3, opaque], axis=-1)).save(tmp_path / "rgba.png")
    tifffile.imwrite(tmp_path / "rgb.tif", np.stack([grey] * 3, axis=-1), photometric="rgb")
    tifffile.imwrite(tmp_path / "planes.tif", np.stack([grey] * 3), photometric="rgb", planarconfig="separate")
    for name in ("rgb.png", "rgba.png", "rgb.tif", "planes.tif"):
        np.testing.assert_array_equal(read_image(tmp_path / name), grey)


def test_colour_and_jpeg_are_refused(tmp_path: Path) -> None:
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[4, 4] = 90, 90, 91
    Image.fromarray(pixels).save(tmp_path / "colour.png")
    Image.fromarray(pixels).save(tmp_path / "frame.jpg")
    with pytest.raises(InputError, match="is a colour image; save one of its channels as a grey image"):
        read_image(tmp_path / "colour.png")
    with pytest.raises(InputError, match="such as text or JPEG; save the frame as TIFF"):
        read_image(tmp_path / "frame.jpg")


def test_damaged_picture_is_refused(tmp_path: Path) -> None:
    whole = tmp_path / "whole.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (90, 90), np.uint8)).save(whole)
    (tmp_path / "cut.png").write_bytes(whole.read_bytes()[:5000])
    with pytest.raises(InputError, match=r"cut\.png: cannot be read as .*: it is damaged or too large"):
        read_image(tmp_path / "cut.png")


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("empty.tif", b"", "it is empty"),
        ("frame.pdf", b"%PDF-1.4\n", "it is another kind of file"),
        ("cut.png", b"\x89PNG\r\n\x1a\n" + bytes(40), "it is damaged or too large"),
    ],
)
def test_damaged_images_are_refused_without_other_lines(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, content: bytes, sentence: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=sentence):
        read_image(tmp_path / name)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("compression", "name"), [(5, "LZW"), (50000, "ZSTD")])
def test_compression_that_cannot_be_undone_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compression: int, name: str
) -> None:
    monkeypatch.setitem(sys.modules, "compression", None)  # Python 3.14 would undo ZSTD
    path = tmp_path / "frame.tif"
    Image.fromarray(IMAGE).save(path, compression="tiff_lzw")
    entry = struct.pack("<HHL", 259, 3, 1)  # Pillow for Windows cannot write ZSTD
    assert entry + b"\5\0" in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(entry + b"\5\0", entry + struct.pack("<H", compression)))
    with pytest.raises(InputError, match=rf"it is compressed \({name}\); save it without compression$"):
        read_image(path)


def test_damage_inside_an_image_is_one_sentence(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The libraries that read it print lines of their own, past Python's standard error."""
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (90, 90), np.uint8)).save(tmp_path / "whole.png")
    flipped = bytearray((tmp_path / "whole.png").read_bytes())
    flipped[4000] ^= 255
    (tmp_path / "flipped.png").write_bytes(flipped)
    text = f"{{'descr': '<u2', 'fortran_order': False, 'shape': ({2**40}, {2**40}), }}".encode()
    (tmp_path / "large.npy").write_bytes(b"\x93NUMPY\1\0" + bytes([118, 0]) + text.ljust(117) + b"\n" + bytes(100))
    capfd.readouterr()
    for name in ("flipped.png", "large.npy"):
        with pytest.raises(InputError, match=rf"{name}: cannot be read as"):
            read_image(tmp_path / name)
    assert capfd.readouterr() == ("", "")


def test_counts_of_any_type_are_limited(tmp_path: Path) -> None:
    np.save(tmp_path / "least.npy", np.full((3, 4), np.iinfo(np.int64).min))
    with pytest.raises(InputError, match="holds values beyond"):
        read_image(tmp_path / "least.npy")


def test_file_of_too_many_pixels_is_not_read(tmp_path: Path) -> None:
    """It takes no space on the disk, but 14 GB in memory."""
    path = tmp_path / "huge.npy"
    np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=(60000, 60000))
    with pytest.raises(InputError, match="60000 x 60000 pixels are too many"):
        read_image(path)

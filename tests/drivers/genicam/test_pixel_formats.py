"""Pixel formats: unpacking against the layouts of PFNC and GigE Vision, choice, saturation."""

from __future__ import annotations

import ctypes
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.genicam._frames import (
    PIXEL_FORMATS,
    ByteOrder,
    PixelFormat,
    Saturation,
    byte_order_of,
    copied_pixels,
    preferred_format,
)


def packed(counts: list[int], pixel_format: PixelFormat, byte_order: ByteOrder = "little") -> bytes:
    """Pixels as a camera sends them, by the text of the standards."""
    if pixel_format.packing == "none":
        return b"".join(count.to_bytes(1 if pixel_format.bits == 8 else 2, byte_order) for count in counts)
    if pixel_format.packing == "pfnc":  # bits of one long number, lowest first
        number = sum(count << i * pixel_format.bits for i, count in enumerate(counts))
        return number.to_bytes(-(-len(counts) * pixel_format.bits // 8), "little")
    low_bits = pixel_format.bits - 8
    content = bytearray()
    for first, second in itertools.zip_longest(counts[::2], counts[1::2]):
        low = first % (1 << low_bits) | (second or 0) % (1 << low_bits) << 4
        content += bytes((first >> low_bits, low) if second is None else (first >> low_bits, low, second >> low_bits))
    return bytes(content)


def arrived(
    sent: bytes, shape: tuple[int, int], name: str, order: ByteOrder = "little", padding: int = 0
) -> NDArray[np.uint16]:
    memory = ctypes.create_string_buffer(sent, len(sent))
    pixels = copied_pixels(
        ctypes.addressof(memory), shape, row_padding_bytes=padding, pixel_format=PIXEL_FORMATS[name], byte_order=order
    )
    memory.raw = bytes(len(sent))
    assert pixels.dtype == np.uint16
    assert not pixels.flags.writeable
    return pixels


@pytest.mark.parametrize("name", PIXEL_FORMATS)
@given(data=st.data())
def test_pixels_arrive_as_packed(name: str, data: st.DataObject) -> None:
    pixel_format = PIXEL_FORMATS[name]
    rows, columns = data.draw(st.integers(1, 5)), data.draw(st.integers(1, 9))
    counts = data.draw(st.lists(st.integers(0, 2**pixel_format.bits - 1), min_size=45, max_size=45))[: rows * columns]
    order: ByteOrder = data.draw(st.sampled_from(["little", "big"]))
    sent = packed(counts, pixel_format, order)
    assert pixel_format.size_bytes(len(counts)) == len(sent)
    np.testing.assert_array_equal(arrived(sent, (rows, columns), name, order).ravel(), counts)


@pytest.mark.parametrize("name", PIXEL_FORMATS)
def test_row_padding_is_left_out(name: str) -> None:
    pixel_format = PIXEL_FORMATS[name]
    counts = (np.arange(12) * 21 % (pixel_format.full_scale + 1)).reshape(3, 4)
    sent = b"".join(packed(row, pixel_format) + b"\xee\xee" for row in counts.tolist())
    np.testing.assert_array_equal(arrived(sent, (3, 4), name, padding=2), counts)


@pytest.mark.parametrize(
    ("offered", "digitiser_bits", "chosen"),
    [
        (("Mono8", "Mono16", "Mono12p", "Mono12Packed"), None, "Mono12p"),  # Grasshopper3, USB3
        (("Mono8", "Mono12Packed", "Mono16", "BayerRG8"), None, "Mono12Packed"),  # Blackfly, GigE
        (("Mono16", "Mono12p", "Mono12Packed", "Mono10p", "Mono10Packed", "Mono8"), 10, "Mono10p"),  # Blackfly S
        (("Mono16", "Mono12p", "Mono12Packed", "Mono10p", "Mono10Packed", "Mono8"), 12, "Mono12p"),
        (("Mono8", "Mono10", "Mono12", "Mono12Packed", "Mono14"), 12, "Mono12"),  # Manta
        (("Mono8", "Mono10", "Mono12", "Mono12Packed", "Mono14"), 14, "Mono14"),
        (("Mono8", "Mono12", "Mono16"), 14, "Mono16"),  # a narrower format would lose bits
        (("Mono8", "Mono16"), None, "Mono16"),
        (("Mono8", "Mono10"), 12, "Mono10"),
        (("Mono8",), 12, "Mono8"),
    ],
)
def test_format_keeps_bits_without_padding(offered: tuple[str, ...], digitiser_bits: int | None, chosen: str) -> None:
    assert preferred_format(offered, digitiser_bits) == PIXEL_FORMATS[chosen]


def test_colour_camera_has_no_grey_format() -> None:
    assert preferred_format(("BayerRG8", "RGB8"), 12) is None


@pytest.mark.parametrize(
    ("name", "digitiser_bits", "reported", "counts", "full_scale"),
    [
        ("Mono16", None, None, [], 65535),  # before the first frame
        ("Mono16", None, None, [0, 0], 65535),  # without light
        ("Mono16", None, None, [16, 4096, 320], 65520),  # 12 bits, left-aligned
        ("Mono16", None, None, [64, 6400, 640], 65472),  # 10 bits
        ("Mono16", None, None, [4, 8, 12], 65532),  # 14 bits
        ("Mono16", None, None, [1, 4095], 65535),  # right-aligned bits cannot be told from 16
        ("Mono16", 14, None, [1, 16382], 16383),  # unless the camera reports its digitiser
        ("Mono16", 12, None, [16, 4096, 320], 65520),
        ("Mono16", 12, None, [16, 65520, 320], 65520),
        ("Mono16", 12, None, [5, 60001], 65535),  # processed to 16 bits
        ("Mono16", 12, 65520, [5, 60001], 65520),
        ("Mono16", None, 16383, [1, 16383], 16383),
        ("Mono16", None, 255, [1, 16383], 65535),  # an impossible report
        ("Mono12p", 10, None, [4, 4092], 4092),
        ("Mono12", None, None, [1, 4095], 4095),
        ("Mono8", None, None, [2, 254], 255),
    ],
)
def test_full_scale_follows_the_used_bits(
    name: str, digitiser_bits: int | None, reported: int | None, counts: list[int], full_scale: int
) -> None:
    saturation = Saturation(PIXEL_FORMATS[name], digitiser_bits, reported)
    for count in counts:
        saturation.observe(np.array([[count]], np.uint16))
    assert saturation.counts == full_scale


@pytest.mark.parametrize(
    ("model", "is_reported_big", "order"),
    [
        ("Point Grey Research Blackfly BFLY-PGE-31S4M 14", False, "big"),
        ("Point Grey Research Grasshopper3 GS3-U3-51S5M", False, "little"),
        ("Basler acA640", True, "big"),
        ("FLIR Systems A305sc", False, "big"),
        ("FLIR Systems A320G", False, "big"),
    ],
)
def test_byte_order_is_that_of_the_model(model: str, is_reported_big: bool, order: str) -> None:
    assert byte_order_of(model, is_reported_big=is_reported_big) == order

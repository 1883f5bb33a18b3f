"""Light of images of any kind above the dark, and their saturated pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from reconstruction.errors import ReconstructionError
from reconstruction.frame.pixels import DarkSubtractor, KnownCamera

SHAPE = (40, 56)
DARK = np.random.default_rng(1).normal(100.0, 3.0, SHAPE)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, np.uint32, np.float32, np.float64])
@pytest.mark.parametrize("is_contiguous", [True, False])
def test_dark_is_subtracted_without_wrapping(kind: Any, is_contiguous: bool) -> None:
    pixels = np.random.default_rng(2).integers(0, 250, (SHAPE[0], 2 * SHAPE[1])).astype(kind)
    image = np.ascontiguousarray(pixels[:, ::2]) if is_contiguous else pixels[:, ::2]
    before = image.copy()
    light, saturated = DarkSubtractor(SHAPE, KnownCamera(DARK, 249.5))(image, "frame")
    np.testing.assert_allclose(light, image.astype(np.float64) - DARK, atol=1e-4)
    assert light.dtype == np.float32
    assert light.flags.writeable
    assert not saturated.any()
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32, np.float32])
@pytest.mark.parametrize("dark", [None, DARK])
def test_pixels_from_full_scale_on_are_saturated(kind: Any, dark: Any) -> None:
    image = np.full(SHAPE, 150).astype(kind)
    image[3, 5], image[4, 6], image[0, 0] = 200, 255, 199
    _, saturated = DarkSubtractor(SHAPE, KnownCamera(dark, 199.5))(image, "frame")
    np.testing.assert_array_equal(np.argwhere(saturated), [[3, 5], [4, 6]])
    _, saturated = DarkSubtractor(SHAPE, KnownCamera(dark))(image, "frame")
    assert not saturated.any()
    for clipped, full_scale in ((255, 199.5), (200, 200.0)):
        image[:2] = clipped
        with pytest.raises(ReconstructionError, match="the frame is saturated"):
            DarkSubtractor(SHAPE, KnownCamera(dark, full_scale))(image, "frame")


def test_without_a_dark_the_darkest_percent_is_the_background() -> None:
    image = np.random.default_rng(3).integers(80, 4000, SHAPE).astype(np.uint16)
    light, _ = DarkSubtractor(SHAPE, KnownCamera())(image, "frame")
    np.testing.assert_allclose(light, image - np.percentile(image, 1.0), atol=1e-2)


@pytest.mark.parametrize(
    ("image", "text"),
    [
        (np.zeros((40, 57), np.uint16), "the frame has 40 x 57 pixels, but the reference has 40 x 56"),
        (np.zeros((40, 56, 3), np.uint16), "the frame has 40 x 56 x 3 pixels"),
        (np.zeros(SHAPE, np.complex64), "the frame holds complex64 values"),
        (np.full(SHAPE, np.nan), "the frame holds values that are not finite"),
    ],
)
def test_other_images_are_refused(image: Any, text: str) -> None:
    with pytest.raises(ReconstructionError, match=text):
        DarkSubtractor(SHAPE, KnownCamera(DARK))(image, "frame")

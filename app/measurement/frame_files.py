"""A frame from an image file, in place of one that the camera takes."""

import time
from pathlib import Path

import numpy as np

from app.errors import InputError
from app.images import read_image
from drivers.interface import Camera, Frame


def read_frame(path: Path, camera: Camera) -> Frame:
    """Read an image file as a frame with the exposure and gain of a camera.

    Raises
    ------
    InputError
        It is no image of counts from 0 to 65535, or of another size than the camera's frames.
    """
    image, allowed = read_image(path), camera.capabilities
    if image.shape != (allowed.rows, allowed.columns):
        sizes = f"{image.shape[0]} x {image.shape[1]} pixels, the camera's frames {allowed.rows} x {allowed.columns}"
        raise InputError(f"{path}: has {sizes}")
    if not (np.isfinite(image).all() and image.min() >= 0 and image.max() <= np.iinfo(np.uint16).max):
        raise InputError(f"{path}: holds values that are no counts from 0 to 65535")
    now_s = time.perf_counter()
    return Frame(np.rint(image).astype(np.uint16), 0, now_s, now_s, camera.exposure_s, camera.em_gain)

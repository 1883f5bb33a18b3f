"""Pictures of wavefronts and frames for notebooks, as HTML."""

import base64
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.runtime.opencv import cv2

_SIDE_PX = 240  # of the longer side, about
_UNKNOWN = 0.85  # grey of what is NaN


def picture_of_views(views: Floats) -> NDArray[np.uint8]:
    """Wavefronts (view_row, view_column, row, column), blue below 0, red above: (row, column, RGB)."""
    framed = np.pad(views, ((0, 0), (0, 0), (0, 1), (0, 1)), constant_values=np.nan)
    tiled = np.concatenate(np.concatenate(framed, axis=1), axis=1)[:-1, :-1]
    most = np.nanmax(np.abs(tiled), initial=0.0) or 1.0
    share = tiled / most
    colours = np.stack([1 + np.minimum(share, 0), 1 - np.abs(share), 1 - np.maximum(share, 0)], axis=-1)
    return _bytes(np.where(np.isnan(colours), _UNKNOWN, colours))


def picture_of_frame(frame: NDArray[Any]) -> NDArray[np.uint8]:
    """A frame (row, column) in grey from its darkest to its brightest pixel: (row, column, RGB)."""
    step = max(1, max(frame.shape) // _SIDE_PX)
    some = np.asarray(frame[::step, ::step], np.float64)
    darkest, brightest = some.min(), some.max()
    return _bytes(np.repeat(((some - darkest) / (brightest - darkest or 1.0))[..., None], 3, axis=2))


def html(text: str, picture: NDArray[np.uint8]) -> str:
    """A line of text and a picture (row, column, RGB) below it, whose pixels are enlarged."""
    times = max(1, _SIDE_PX // max(picture.shape))
    large = picture.repeat(times, axis=0).repeat(times, axis=1)
    png = cv2.imencode(".png", large[..., ::-1])[1].tobytes()
    return f'<p>{escape(text)}</p><img src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def _bytes(colours: Floats) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255 * colours), np.uint8)

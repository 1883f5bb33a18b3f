"""OpenCV, which makes child processes load libraries from the working folder: such a file runs code.

It ends `LD_LIBRARY_PATH` with a colon, and an empty entry means that folder. All modules import OpenCV from here.
"""

import os

import cv2

_FOLDERS = "LD_LIBRARY_PATH"
os.environ[_FOLDERS] = ":".join(filter(None, os.environ.get(_FOLDERS, "").split(":")))

__all__ = ["cv2"]

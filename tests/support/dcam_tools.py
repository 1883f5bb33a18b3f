"""The DCAM stand-in, compiled once, and the driver over it."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from drivers.dcam import DcamSettings
from drivers.dcam._library import DcamLibrary, load_library
from drivers.dcam.camera import DcamCamera
from support.stand_ins.dcam.build import NoCompiler, build
from support.stand_ins.dcam.stand_in import StandIn


@cache
def built() -> Path:
    if library := os.environ.get("SVWFS_DCAM_STAND_IN"):  # as under Wine, where there is no compiler
        return Path(library)
    folder = tempfile.mkdtemp(prefix="svwfs-dcam-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return build(Path(folder))


@contextmanager
def compiling() -> Iterator[None]:
    """Fail with one line of advice if there is no compiler."""
    try:
        yield
    except NoCompiler as error:
        pytest.fail(str(error), pytrace=False)


@contextmanager
def dcam_stand_in(speed: float = 0.0) -> Iterator[StandIn]:
    """Yield a reset stand-in; assert that all sessions are ended."""
    with compiling():
        stand_in = StandIn(built())
    stand_in.reset(speed)
    yield stand_in
    assert not library(stand_in).users


def library(stand_in: StandIn) -> DcamLibrary:
    return load_library(str(stand_in.library))


def open_camera(stand_in: StandIn, **settings: Any) -> DcamCamera:
    """Open the driver over the stand-in, on its clock."""
    return DcamCamera(DcamSettings(**settings), library=library(stand_in), clock=stand_in.now)

"""The folder of a store: whether it holds one, may hold one, and has one writer."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import xarray as xr

from app.errors import InputError
from app.files import check_writable, in_words, make_folder
from app.recording.folder import lock
from app.recording.frame_array import METADATA

FORMAT = "svwfs batch 1"


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Check the folder of a store, and keep other runs out; `InputError` if one writes into it already."""
    check_free(folder)
    make_folder(folder.parent)
    with folder.with_name(f".{folder.name}.lock").open("ab") as file:
        try:
            lock(file)
        except InputError as error:
            raise InputError(f"{folder}: another svwfs batch is writing into it") from error
        yield


def is_store(folder: Path) -> bool:
    """True if a folder holds a whole store; a run may have been killed while it made one."""
    return "job" in store_attributes(folder)


def store_attributes(folder: Path) -> dict[str, Any]:
    """Attributes of a store; empty if the folder holds none."""
    try:
        attributes = json.loads((folder / METADATA).read_text("utf-8"))["attributes"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}
    return attributes if isinstance(attributes, dict) and attributes.get("format") == FORMAT else {}


def open_store(folder: Path) -> xr.Dataset:
    """Open a store for reading; arrays are read when they are used. `InputError` if the folder holds none."""
    if not is_store(folder):
        raise InputError(f"{folder}: holds no results of svwfs batch; svwfs.open_recording opens a recording")
    try:
        results: xr.Dataset = xr.open_zarr(folder, consolidated=True)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{folder}: cannot be read as results of svwfs batch: {in_words(error)}") from error
    return results


def check_free(folder: Path) -> None:
    """Raise `InputError` if a folder cannot hold a store."""
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; the results need a folder")
        if folder.is_dir() and not store_attributes(folder) and any(folder.iterdir()):
            raise InputError(f"{folder}: exists already and holds no results of svwfs batch")
        check_writable(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be used: {in_words(error)}") from error

"""Image files and atomic writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from app.errors import InputError, RunError
from app.files import atomic_write, read_image, write_image

IMAGE = np.arange(12, dtype=np.uint16).reshape(3, 4)


def test_written_images_are_read_back(tmp_path: Path) -> None:
    write_image(tmp_path / "image.tif", IMAGE)
    np.save(tmp_path / "image.npy", IMAGE)
    np.testing.assert_array_equal(read_image(tmp_path / "image.tif"), IMAGE)
    np.testing.assert_array_equal(read_image(tmp_path / "image.npy"), IMAGE)


def test_unusable_image_error_names_file(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "colour.tif", np.zeros((8, 8, 3), np.uint8), photometric="rgb")
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


def test_failed_write_keeps_old_file(tmp_path: Path) -> None:
    path = tmp_path / "result.nc"
    path.write_text("old")

    def fail_half_way() -> None:
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail_half_way()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_unwritable_folder_raises_run_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="folder cannot be made"):
        write_image(tmp_path / "file" / "image.tif", IMAGE)

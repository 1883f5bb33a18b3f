"""Image files and atomic writes."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
import tifffile

from app.errors import InputError, RunError
from app.files import RECORDING_PARTS, atomic_write, check_outputs, check_suffix, read_image, write_image

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
    with pytest.raises(InputError, match="holds 2 images; save one frame"):
        read_image(tmp_path / "two.tif")


def test_negative_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "negative.tif", IMAGE, photometric="miniswhite")
    with pytest.raises(InputError, match="a negative, in which 0 is white"):
        read_image(tmp_path / "negative.tif")


def test_link_that_leads_nowhere_is_named(tmp_path: Path) -> None:
    for name in ("itself.tif", "dangling.tif"):
        (tmp_path / name).symlink_to(tmp_path / name.replace("dangling", "nowhere"))
        with pytest.raises(InputError, match=f"{name}: is a symbolic link that leads to no file"):
            read_image(tmp_path / name)


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


def test_outputs_never_replace_inputs(tmp_path: Path) -> None:
    frame, link, hard_link, folder = (tmp_path / name for name in ("frame.tif", "link.tif", "hard.tif", "run"))
    write_image(frame, IMAGE)
    link.symlink_to(frame)
    hard_link.hardlink_to(frame)
    folder.mkdir()
    for output in (frame, link, hard_link, tmp_path / "run" / ".." / "frame.tif", folder / "new" / "run.json"):
        with pytest.raises(InputError, match="is used by this command already"):
            check_outputs([output], inputs=[frame, None, folder], overwrite=True)
    with pytest.raises(InputError, match="is used by this command already"):
        check_outputs([tmp_path / "new", None, tmp_path / "new"], overwrite=True)


def test_parts_of_any_recording_are_never_replaced(tmp_path: Path) -> None:
    run, free = tmp_path / "run", tmp_path / "free"
    for folder in (run, free):
        folder.mkdir()
        (folder / "run.json").touch()
    (run / "frames.jsonl").touch()
    (tmp_path / "link").symlink_to(run)
    for part in (*RECORDING_PARTS, "calibrations/0/bench.toml"):
        for folder in (run, tmp_path / "link"):
            with pytest.raises(InputError, match="is part of a recording; give the output another name"):
                check_outputs([folder / part], overwrite=True)
        check_outputs([free / part], overwrite=True)
    check_outputs([run / "results.nc"], overwrite=True)


def test_name_of_another_format_is_refused() -> None:
    for name in ("frame.tif", "run/plot.PNG", "bench.toml"):
        with pytest.raises(InputError, match=f"{name}: the file will not be what its name says: end it with .nc"):
            check_suffix(Path(name), ".nc")
    for path in (Path("result"), Path("result.v2"), Path("result.NC"), None):
        check_suffix(path, ".nc")


def test_existing_outputs_need_overwrite(tmp_path: Path) -> None:
    there, dangling = tmp_path / "there.nc", tmp_path / "dangling.nc"
    there.touch()
    dangling.symlink_to(tmp_path / "nowhere")
    for output in (there, dangling):
        with pytest.raises(InputError, match="exists already; --overwrite replaces it"):
            check_outputs([output], overwrite=False)
        check_outputs([output], overwrite=True)
    for output in (tmp_path, tmp_path / ("a" * 300), there / "inside"):
        with pytest.raises(InputError):
            check_outputs([output], overwrite=True)


def test_partial_file_follows_no_symlink(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    victim, names = tmp_path / "victim", iter(("guessed", "other"))
    victim.write_text("precious")
    monkeypatch.setattr("app.files.secrets.token_hex", lambda _: next(names))
    (tmp_path / ".guessed.partial.txt").symlink_to(victim)
    with pytest.raises(RunError, match="File exists"), atomic_write(tmp_path / "new.txt") as temporary:
        temporary.write_text("harm")
    assert victim.read_text() == "precious"
    with atomic_write(tmp_path / "new.txt") as temporary:
        temporary.write_text("good")
    assert (tmp_path / "new.txt").read_text() == "good"


def test_partial_names_differ(tmp_path: Path) -> None:
    names = set()
    for _ in range(20):
        with atomic_write(tmp_path / ("n" * 251 + ".txt")) as temporary:  # as long as a name can be
            names.add(temporary.name)
            assert temporary.stat().st_mode & 0o777 == 0o666 & ~_umask()
    assert len(names) == 20


def _umask() -> int:
    before = os.umask(0)
    os.umask(before)
    return before


def test_file_is_on_disk_before_it_gets_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, synced = tmp_path / "run.json", []

    def note(file: int) -> None:
        synced.append((Path(f"/proc/self/fd/{file}").resolve(), path.exists(), os.fstat(file).st_size))

    monkeypatch.setattr(os, "fsync", note)
    with atomic_write(path) as temporary:
        temporary.write_text("four")
    assert [(synced[0][0], *synced[0][1:]), synced[1][:2]] == [(temporary, False, 4), (tmp_path, True)]


def test_failed_sync_keeps_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    path = tmp_path / "run.json"
    path.write_text("old")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(RunError, match=r"run\.json: cannot be written: Input/output error"), atomic_write(path) as new:
        new.write_text("new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_image_files_that_lie_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.npy").write_text("no array")
    header = np.lib.format.MAGIC_PREFIX + b"\x01\x00v\x00"
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (999999, 999999), }"
    (tmp_path / "bomb.npy").write_bytes(header + text.ljust(117) + b"\n" + bytes(100))
    huge = np.zeros((2**15, 2**14), np.uint8)
    tifffile.imwrite(tmp_path / "bomb.tif", huge, compression="deflate")
    os.mkfifo(tmp_path / "pipe.npy")
    sentences = {"text.npy": "does not begin as an NPY file", "bomb.npy": "cannot be read", "bomb.tif": "are too many"}
    for name, sentence in (sentences | {"pipe.npy": "not a file", "a" * 300: "File name too long"}).items():
        with pytest.raises(InputError, match=sentence) as fault:
            read_image(tmp_path / name)
        assert "\n" not in str(fault.value)

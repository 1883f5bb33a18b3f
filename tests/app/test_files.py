"""Checked and atomic writes."""

from __future__ import annotations

import errno
import ntpath
import os
import re
from pathlib import Path

import numpy as np
import pytest
from support.posix import resource
from support.windows import refusing

from app.errors import InputError, RunError
from app.files import (
    RECORDING_PARTS,
    atomic_write,
    check_outputs,
    check_suffix,
    check_writable,
    file_name_problem,
    reachable,
    write_whole,
)
from app.images import write_image

IMAGE = np.arange(12, dtype=np.uint16).reshape(3, 4)


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


@pytest.mark.posix
def test_full_disk_is_told_alike_by_images_and_texts(tmp_path: Path) -> None:
    """A limit on the size of files stands for the size of the disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(RunError) as of_image:
            write_image(tmp_path / "file", np.zeros((99, 99)))
        with pytest.raises(RunError) as of_text:
            write_whole(tmp_path / "file", bytes(9999))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert str(of_image.value) == str(of_text.value) == f"{tmp_path / 'file'}: cannot be written: File too large"
    assert not list(tmp_path.iterdir())


def test_read_only_disk_is_called_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number, why in ((errno.EACCES, "no permission to write there"), (errno.EROFS, "the disk is read-only")):
        monkeypatch.setattr("os.open", refusing(number))
        with pytest.raises(InputError, match=f"^{re.escape(str(tmp_path))}: {why}$"):
            check_writable(tmp_path / "new")


def test_the_trial_leaves_nothing(tmp_path: Path) -> None:
    check_writable(tmp_path / "new" / "er")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name", ["CON", "nul.txt", "com1", "Lpt9.tar.gz", "aux .nc", "COM\xb2", "a.", "a ", *'<>:"|?*', "a\\b"]
)
def test_names_that_windows_forbids_are_known(name: str) -> None:
    """ "Naming Files, Paths, and Namespaces" of Microsoft's documentation."""
    assert file_name_problem(name)


@pytest.mark.parametrize("name", ["run 7.nc", "console.txt", "com10", "nulls", ".hidden", "a.b", "20261128-120000-con"])
def test_other_names_are_possible(name: str) -> None:
    assert not file_name_problem(name)


def test_windows_refuses_such_an_output_and_linux_does_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = tmp_path / "a?b" / "nul.nc"
    if os.name == "posix":
        check_outputs([output], overwrite=False)
    monkeypatch.setattr("app.files.sys.platform", "win32")
    with pytest.raises(InputError, match=r"the name a\?b cannot contain \?$"):
        check_outputs([output], overwrite=False)
    with pytest.raises(InputError, match=r"the name nul.nc is reserved by Windows for a device$"):
        check_outputs([tmp_path / ".." / output.name], overwrite=False)
    check_outputs([tmp_path / ".." / "new.nc"], overwrite=False)


def test_long_paths_are_extended_on_windows_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """ "Maximum Path Length Limitation" of Microsoft's documentation."""
    monkeypatch.setattr("os.path.abspath", ntpath.normpath)
    short, long, shared = (
        Path(text) for text in ("C:\\run", "C:\\x\\..\\" + "a" * 200, "\\\\server\\share\\" + "a" * 200)
    )
    monkeypatch.setattr("app.files.sys.platform", "linux")
    assert reachable(long) == long
    monkeypatch.setattr("app.files.sys.platform", "win32")
    assert reachable(short) == short
    assert str(reachable(long)) == "\\\\?\\C:\\" + "a" * 200
    assert str(reachable(shared)) == "\\\\?\\UNC\\server\\share\\" + "a" * 200
    assert reachable(reachable(long)) == reachable(long)


def test_outputs_never_replace_inputs(tmp_path: Path) -> None:
    frame, link, hard_link, folder = (tmp_path / name for name in ("frame.tif", "link.tif", "hard.tif", "run"))
    write_image(frame, IMAGE)
    if os.name == "posix":  # Windows asks for rights to make a link
        link.symlink_to(frame)
    else:
        link.hardlink_to(frame)
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
    folders = [run]
    if os.name == "posix":  # Windows asks for rights to make a link
        (tmp_path / "link").symlink_to(run)
        folders.append(tmp_path / "link")
    for part in (*RECORDING_PARTS, "calibrations/0/bench.toml"):
        for folder in folders:
            with pytest.raises(InputError, match="is part of a recording; give the output another name"):
                check_outputs([folder / part], overwrite=True)
        check_outputs([free / part], overwrite=True)
    check_outputs([run / "results.nc"], overwrite=True)
    for name in ("results.nc", "dark.tif"):
        (run / name).touch()
        with pytest.raises(InputError, match="was written when this was measured; give the output another name"):
            check_outputs([run / name], overwrite=True)


def test_name_of_another_format_is_refused() -> None:
    for name in ("frame.tif", "run/plot.PNG", "bench.toml", "result.txt", "result.v2"):
        said = f"{Path(name)}: {Path(name).suffix} does not fit the format: end the name with .nc"
        with pytest.raises(InputError, match=re.escape(said)):
            check_suffix(Path(name), ".nc")
    for path in (Path("result"), Path("result.NC"), None):
        check_suffix(path, ".nc")


@pytest.mark.posix  # Windows asks for rights to make a link
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


@pytest.mark.posix  # Windows asks for rights to make a link
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


@pytest.mark.posix
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

"""The address of an instrument for its clients: one folder for each user, one instrument for each name."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from app.acquisition.address import Address, clear_abandoned, file_of, runtime_folder, taken_address
from app.acquisition.remote.connection import reach
from app.acquisition.streams.ring import RingWriter
from app.errors import InputError, RunError

pytestmark = pytest.mark.usefixtures("runtime_folder")


def test_without_an_instrument_the_sentence_says_how_to_start_one() -> None:
    with pytest.raises(RunError, match=r"no instrument runs: start one with svwfs serve"):
        reach("test")
    (runtime_folder() / "instrument.json").write_text("{")  # of a killed one
    with pytest.raises(RunError, match="no instrument runs"):
        reach("test")
    assert [each.name for each in runtime_folder().iterdir()] == ["instrument.lock"]


@pytest.mark.posix  # Windows has no file of it
def test_the_ring_of_a_killed_instrument_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under Linux it has no file."""
    for name in ("instrument", "other"):
        with monkeypatch.context() as elsewhere:
            elsewhere.setattr("sys.platform", "darwin")
            ring = RingWriter(1000, file_of(name, "ring"))
        ring._file = None
        ring.close()  # all that a kill closes
        file_of(name, "json").touch()
    clear_abandoned("instrument")
    left = sorted(each.name.partition("-")[0] for each in runtime_folder().iterdir())
    assert left == ["instrument.lock", "other.json", "other.ring"]


@pytest.mark.posix
def test_folder_of_another_user_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    of_another = os.getuid() + 1
    monkeypatch.setattr("os.getuid", lambda: of_another)
    with pytest.raises(RunError, match="belongs to another user: set SVWFS_RUNTIME_DIR to a folder of yours"):
        runtime_folder()


def test_log_that_has_grown_begins_anew_without_zeros() -> None:
    """As on Windows, the place where a process prints does not follow the end of the file."""
    with file_of("instrument", "log").open("wb") as log:
        log.write(b"much\n" * 250_000)
        log.flush()
        bound = "import sys; from app.acquisition.address import bound_log; bound_log('instrument')"
        command = [sys.executable, "-c", f"{bound}; sys.stderr.write('again')"]
        subprocess.run(command, check=True, stderr=log)  # noqa: S603 - this interpreter
    assert file_of("instrument", "log").read_bytes() == b"again"


def test_a_place_belongs_to_one_instrument() -> None:
    with taken_address() as address:
        address.announce()
        assert Address.of() == address
        with pytest.raises(RunError, match="named instrument is running already"), taken_address():
            pass
        with taken_address("second") as second:
            assert second.endpoint != address.endpoint or second.endpoint.endswith(":*")  # any port, on Windows
    with pytest.raises(RunError, match="no instrument runs"):
        Address.of()


@pytest.mark.parametrize("name", ["", "../x", "a b", "a/b", "con", "COM1"])
def test_names_that_are_no_words_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="cannot have the name"), taken_address(name):
        pass
    with pytest.raises(InputError, match="cannot have the name"):
        Address.of(name)


@pytest.mark.posix  # Windows has a temporary folder for each user
def test_desktop_and_cron_find_the_same_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("SVWFS_RUNTIME_DIR")
    found = set[Path]()
    for variables in ({}, {"XDG_RUNTIME_DIR": str(tmp_path), "TMPDIR": str(tmp_path)}):
        for name in ("XDG_RUNTIME_DIR", "TMPDIR"):
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr("tempfile.tempdir", None)
        found.add(runtime_folder())
    assert found == {Path(f"/tmp/svwfs-{os.getuid()}")}  # noqa: S108 - the folder that is meant


@pytest.mark.posix  # Windows protects the temporary folder by access lists
def test_a_folder_that_others_may_enter_is_refused() -> None:
    runtime_folder().chmod(0o755)
    with pytest.raises(RunError, match="open to others"), taken_address():
        pass

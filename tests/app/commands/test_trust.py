"""A library that a bench names is loaded only after it was confirmed once."""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from support.command_line import run

from app.bench import trusted_libraries
from app.bench.config import Bench, load_bench, write_bench
from app.commands.terminal import confirm_libraries
from app.errors import InputError
from drivers.dcam import DcamSettings
from drivers.micro_manager import MicroManagerSettings
from drivers.serial_lights import CoolLEDSettings

LIGHT = CoolLEDSettings(port="/dev/nowhere")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    path = tmp_path / "libevil.so"
    path.write_bytes(b"code")
    bench = replace(load_bench("small_demo"), camera=DcamSettings(library=str(path)), light=LIGHT)
    (tmp_path / "bench.toml").write_text(write_bench(bench))
    return path


@pytest.fixture
def bench(library: Path) -> Bench:
    return load_bench(library.with_name("bench.toml"))


def answer(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal(text))


def test_library_is_refused_without_terminal(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("yes\n"))
    with pytest.raises(InputError, match=r"camera\.library = .*libevil\.so would run code: add --trust-library once"):
        confirm_libraries(bench, is_trusted=False)


def test_folder_of_adapters_is_confirmed_too(bench: Bench, library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = MicroManagerSettings(adapter="DemoCamera", device="DCam", adapter_folder=str(library.parent))
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    with pytest.raises(InputError, match=r"camera\.adapter_folder = .* would run code"):
        confirm_libraries(replace(bench, camera=camera), is_trusted=False)


@pytest.mark.parametrize("text", ["no\n", "\n", "", "y\n"])
def test_refused_library_is_asked_for_again(bench: Bench, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    for _ in range(2):
        answer(monkeypatch, text)
        with pytest.raises(InputError, match="is not trusted"):
            confirm_libraries(bench, is_trusted=False)


@pytest.mark.parametrize("trust", [True, False])
def test_confirmed_path_is_asked_for_once(
    bench: Bench, library: Path, monkeypatch: pytest.MonkeyPatch, trust: bool
) -> None:
    answer(monkeypatch, "yes\n")
    confirm_libraries(bench, is_trusted=trust)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    confirm_libraries(bench, is_trusted=False)
    other = replace(bench, camera=DcamSettings(library=str(library.with_name("libother.so"))))
    with pytest.raises(InputError, match="would run code"):
        confirm_libraries(other, is_trusted=False)
    confirm_libraries(other, is_trusted=True)
    confirm_libraries(bench, is_trusted=False)


def test_damaged_list_of_trusted_paths_trusts_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    confirm_libraries(bench, is_trusted=True)
    for text in ("", "3", "[[1]]", "["):
        trusted_libraries._file().write_text(text)
        monkeypatch.setattr(sys, "stdin", io.StringIO())
        with pytest.raises(InputError, match="would run code"):
            confirm_libraries(bench, is_trusted=False)


def test_bench_without_library_needs_no_confirmation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    confirm_libraries(load_bench("small_demo"), is_trusted=False)


@pytest.mark.parametrize("command", ["measure --frames 3 --out r", "live", "devices --check camera"])
def test_commands_that_open_devices_confirm_first(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], library: Path, command: str
) -> None:
    monkeypatch.chdir(library.parent)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    monkeypatch.setattr("ctypes.CDLL", lambda *_, **__: pytest.fail("the library was loaded"))
    assert run(monkeypatch, *command.split(), "--bench", "bench.toml") == 2
    assert "would run code: add --trust-library once if you trust it" in capsys.readouterr().err

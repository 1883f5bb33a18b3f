"""The command line: help, bad arguments, what is loaded, output, and exit status."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import typer.main
from support.command_line import run

from app.bench.config import load_bench, write_bench
from app.bench.device_kinds import CameraSettings, LightSettings
from app.cli.application import cli
from drivers.dcam import DcamSettings
from drivers.genicam import GenicamSettings
from drivers.micro_manager import MicroManagerSettings
from drivers.serial_lights import CoolLEDSettings, DC4100Settings
from drivers.usb_lights import DC2200Settings


@pytest.mark.slow
def test_selftest_passes(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "selftest") == 0
    assert capsys.readouterr().out.count("ok") == 6


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (("measure", "--bench", "nowhere.toml", "--frames", "3", "--out", "x"), "nowhere.toml: no such file"),
        (("measure", "--bench", "live_demo", "--frames", "0", "--out", "x"), "Invalid value for '--frames'"),
        (("simulate", "--bench", "live_demo", "--set", "sensor.colour=3", "--out", "x"), "sensor.colour is an unknown"),
        (("nonsense",), "No such command"),
    ],
)
def test_bad_arguments_exit_with_status_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: tuple[str, ...], sentence: str
) -> None:
    assert run(monkeypatch, *command) == 2
    assert sentence in capsys.readouterr().err


GROUP = typer.main.get_command(cli)


def commands() -> dict[str, Any]:
    """Every command, imported, with its full name."""
    context = GROUP.make_context("svwfs", [], resilient_parsing=True)
    return {f"svwfs {name}": GROUP.resolve_command(context, [name])[1] for name in GROUP.commands}  # type: ignore[attr-defined] # it is a group


def test_help_lists_every_command_with_its_first_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "--help") == 0
    table = capsys.readouterr().out.partition("Commands:")[2]
    listed = dict(re.findall(r"^  ([\w-]+) {2,}(\S.*?)(?:\.\.\.)?$", table, re.MULTILINE))
    assert len(listed) >= 16
    for name, command in commands().items():
        assert command.get_short_help_str(200).startswith(listed[name.split()[1]])


@pytest.mark.parametrize("name", commands())
def test_help_of_command_has_valid_examples(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    command = commands()[name]
    assert run(monkeypatch, *name.split()[1:], "--help") == 0
    shown = capsys.readouterr().out
    assert all(option in shown for parameter in command.params for option in parameter.opts if option[:2] == "--")
    examples = re.findall(r"Example: (svwfs .*?)(?:\n\n|$)", command.help.strip(), re.DOTALL)
    assert examples
    for example in examples:
        words = shlex.split(example)
        assert " ".join(words).startswith(name)
        command.make_context(name, words[len(name.split()) :])  # exits if it cannot be parsed


REAL_DEVICES: list[tuple[CameraSettings, LightSettings]] = [
    (DcamSettings(), DC4100Settings(port="COM1")),
    (GenicamSettings(), DC2200Settings()),
    (GenicamSettings(), CoolLEDSettings(port="COM1")),
    (MicroManagerSettings(adapter="DemoCamera", device="DCam", properties={"Gain": "2"}), DC2200Settings()),
]
BENCHES_AND_HELP = """
import sys
from app.bench.config import load_bench

def loaded():
    return [name for name in ("usb", "serial", "pymmcore", "numba", "PyQt6") if name in sys.modules]

for path in sys.argv[1:]:
    load_bench(path)
seen = [loaded()]
from app.cli.application import cli
for words in (["--help"], ["measure", "--help"]):
    cli(words, standalone_mode=False)
    seen.append(loaded())
sys.exit(str(seen))
"""


def test_reading_bench_and_help_load_no_devices_numba_or_qt(tmp_path: Path) -> None:
    paths = ["live_demo", *(str(tmp_path / f"{index}.toml") for index in range(len(REAL_DEVICES)))]
    for path, (camera, light) in zip(paths[1:], REAL_DEVICES, strict=True):
        Path(path).write_text(write_bench(replace(load_bench("live_demo"), camera=camera, light=light)))
    command = [sys.executable, "-c", BENCHES_AND_HELP, *paths]
    finished = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603 - our own program
    assert finished.stderr == "[[], [], []]\n"


WITHOUT_RECORDINGS = """
import sys
from app.cli import main

for words in ("batch nowhere neither --out r.zarr", "replay nowhere", "report nowhere --out r.pdf"):
    sys.argv = ["svwfs", *words.split()]
    try:
        main()
    except SystemExit as leaving:
        print(leaving.code, [name for name in ("numba", "scipy", "xarray", "distributed") if name in sys.modules])
"""


def test_command_without_recordings_is_refused_before_anything_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even what the work needs; `batch` would start its workers next."""
    monkeypatch.chdir(tmp_path)
    command = [sys.executable, "-c", WITHOUT_RECORDINGS]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert (done.returncode, done.stdout) == (0, "2 []\n" * 3), done.stderr
    assert [line.split(";")[0] for line in done.stderr.splitlines()] == ["svwfs: nowhere: no such folder"] * 3


def test_programs_that_commands_start_import_nothing_from_the_working_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(monkeypatch, "--version") == 0
    assert os.environ["PYTHONSAFEPATH"] == "1"


MEASURE = "app.acquisition.start_up, app.acquisition.streams.publisher, app.results.run_summary"
WINDOW = "app.acquisition.worker, app.gui.application"
STATISTICS = ("scipy.optimize", "scipy.signal", "scipy.stats")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rooms", "unwanted"),
    [
        pytest.param(MEASURE, ("PyQt6", "matplotlib", "pydantic", *STATISTICS), id="measure"),
        pytest.param(WINDOW, ("matplotlib", "pydantic", "xarray", "pandas", "h5py", "zarr", *STATISTICS), id="window"),
    ],
)
def test_first_picture_waits_for_nothing_that_it_does_not_need(rooms: str, unwanted: tuple[str, ...]) -> None:
    """In a process of its own, loading what is not wanted takes most of a second."""
    program = (
        f"import sys, app.cli.application, {rooms}; sys.exit(any(name.startswith({unwanted}) for name in sys.modules))"
    )
    finished = subprocess.run([sys.executable, "-c", program], check=False)  # noqa: S603 - our own program
    assert finished.returncode == 0


def test_error_is_one_line_without_control_codes(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "recover", "a\x1b[31m\nb\udcff") == 2
    assert capsys.readouterr().err == "svwfs: a\\x1b[31m\\nb\\udcff: no such folder\n"


def test_lack_of_memory_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def exhaust(*_: object, **__: object) -> None:
        raise MemoryError("Unable to allocate 9 TiB")

    monkeypatch.setattr("app.recording.recover.recover", exhaust)
    assert run(monkeypatch, "recover", "run") == 1
    assert capsys.readouterr().err == "svwfs: there is not enough memory: Unable to allocate 9 TiB\n"


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_that_cannot_be_printed_is_one_line(unbuffered: str) -> None:
    program = "import sys; from app.cli import main; main()"
    command = [sys.executable, "-c", program, "devices", "--help"]
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment, check=False)  # noqa: S603 - our own command
    assert (done.returncode, done.stderr) == (1, "svwfs: the output cannot be printed: No space left on device\n")


def test_closed_pipe_ends_silently() -> None:
    program = "import sys, app.cli.application as all; from app.cli import main\n"
    program += "all.cli = lambda: sys.stdout.write('result') and sys.exit(); main()"  # as commands that do not flush
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run([sys.executable, "-c", program], stdout=writing, stderr=subprocess.PIPE, check=False)  # noqa: S603 - our own program
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.parametrize("command", ["replay {}", "layers {} --out o.nc"])
def test_too_long_a_name_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    assert run(monkeypatch, *command.format("x" * 300).split()) == 2
    said = "cannot be used: File name too long" if os.name == "posix" else r"no such .*"
    assert re.fullmatch(rf"svwfs: x{{300}}\S*: {said}\n", capsys.readouterr().err)


def test_ctrl_c_while_the_commands_are_imported_is_one_line() -> None:
    program = "import os, signal, sys; from app.cli import main; sys.argv = ['svwfs', 'selftest']\n"
    program += "class Interrupting:\n    def find_spec(self, name, *_):\n"
    program += "        if name == 'typer': signal.raise_signal(signal.SIGINT)\n"
    program += "sys.meta_path.insert(0, Interrupting()); main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    assert (done.returncode, done.stderr) == (130, "svwfs: interrupted\n")

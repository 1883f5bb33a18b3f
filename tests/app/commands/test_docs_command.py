"""`svwfs docs`, and the hint behind a message on a terminal that leads there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.command_line import run
from support.paths import DOCS

from app.commands.terminal import print_warning
from app.documentation import entries

BENCH = ("--bench", "small_demo")
# Messages that a user provokes, and their entries.
PROVOKED = [
    (("devices", *BENCH), "options-do-not-go-together"),
    (("live", "--bench", "missing.toml"), "a-file-cannot-be-read-or-written"),
    (("simulate", *BENCH, "--out", "d", "--set", "sensor.wavelength_m=3"), "a-setting-is-refused"),
    (("simulate", *BENCH, "--out", "d", "--set", "sensor.colour=3"), "a-setting-is-refused"),
    (("reconstruct", "f.tif", *BENCH, "--reference", "r.tif", "--out", "r.nc"), "a-file-cannot-be-read-or-written"),
    (("reconstruct", "a.png", *BENCH, "--reference", "a.png", "--out", "r.nc"), "an-image-file-cannot-be-used"),
    (("calibrate", *BENCH), "options-do-not-go-together"),
    (("replay", "."), "a-file-cannot-be-read-or-written"),
    (("measure", "--attach", "--frames", "2", "--out", "m"), "no-instrument-runs"),
    (("light-off", "--bench", "manual.toml"), "the-light-is-switched-by-hand"),
    (("mask", "peaks", "--out", "m.svg"), "a-mask-cannot-be-drawn-or-predicted"),
]


def printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str) -> str:
    assert run(monkeypatch, "docs", *words) == 0
    return capsys.readouterr().out


@pytest.mark.usefixtures("runtime_folder")
@pytest.mark.parametrize(("words", "anchor"), PROVOKED, ids=lambda value: value if isinstance(value, str) else value[0])
def test_message_on_a_terminal_names_its_entry(
    words: tuple[str, ...],
    anchor: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.png").write_bytes(b"no picture")
    preset = (Path(__file__).parents[3] / "app" / "bench" / "presets" / "small_demo.toml").read_text("utf-8")
    devices = '[camera]\ndriver = "dcam"\n[light]\ndriver = "manual"\n'
    Path("manual.toml").write_text(re.sub(r"\[(camera|light)\]\n(?:.+\n)*", "", preset) + devices)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    assert run(monkeypatch, *words) != 0
    message = capsys.readouterr().err
    assert message.endswith(f"  (svwfs docs {anchor})\n")
    assert "svwfs: " in message
    assert printed(capsys, monkeypatch, anchor) == f"{entries()[anchor]}\n"


def test_no_hint_for_other_programs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "calibrate", *BENCH) == 2
    print_warning("doubtful: the dark contains 5 % of the reference's light")
    shown = capsys.readouterr()
    assert "svwfs docs" not in shown.err + shown.out


def test_docs_print_pages_and_entries(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    listed = printed(capsys, monkeypatch)
    for path in DOCS.rglob("*.md"):
        assert path.relative_to(DOCS).with_suffix("").as_posix() in listed
    assert printed(capsys, monkeypatch, "tour").startswith("# A tour of the window")
    for words in (("no-dark-yet",), ("No", "dark", "yet"), ("no dark yet: background estimated: take one (D)",)):
        assert printed(capsys, monkeypatch, *words).startswith("No dark yet\n")
    assert run(monkeypatch, "docs", "xyzzy") == 2
    assert "svwfs docs lists the pages" in capsys.readouterr().err


def test_missing_pages_are_reported(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("app.__file__", "/nowhere/app/__init__.py")
    assert run(monkeypatch, "docs") == 2
    assert "not installed" in capsys.readouterr().err

"""`svwfs live`: which bench the window opens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from PyQt6.QtWidgets import QWidget
from support.command_line import run

from app.bench.config import Bench, load_bench


def opened_benches(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Put an empty window in the place of the real one; the list gets the benches that it is told to open."""
    opened: list[str] = []

    class Benches:
        def open(self, name: str, _: tuple[str, ...], **__: Any) -> None:
            opened.append(name)

        def offer_last(self) -> None:
            opened.append("last")

    class Window(QWidget):
        benches = Benches()

    def run_window(open_first: Any, **_: Any) -> int:
        open_first(Window())
        return 0

    monkeypatch.setattr("app.commands.live.use_display", lambda: True)
    monkeypatch.setattr("app.gui.application.run_window", run_window)
    return opened


@pytest.mark.usefixtures("restored_theme", "runtime_folder")
@pytest.mark.parametrize(
    ("arguments", "source", "offers_last"),
    [
        ((), "live_demo", True),
        (("--bench", "small_demo"), "small_demo", False),  # a named bench wins
        (("--set", "registration.warp=affine"), "live_demo", False),
    ],
)
def test_last_bench_is_offered_only_if_none_is_named(
    monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], source: str, *, offers_last: bool
) -> None:
    opened, begun = opened_benches(monkeypatch), list[Bench]()
    monkeypatch.setattr(
        "app.acquisition.remote.own_instrument.OwnInstrument.start", lambda _, bench: begun.append(bench)
    )
    assert run(monkeypatch, "live", *arguments) == 0
    assert opened == [source, *["last"] * offers_last]
    assert begun == [load_bench(source, arguments[1:] if "--set" in arguments else ())]  # while the window is loaded


@pytest.mark.usefixtures("restored_theme", "runtime_folder")
@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("foo", "setting 'foo': write section.key=value"),
        ("sensor.wavelength=1", "live_demo: sensor.wavelength is an unknown key"),
        ("sensor.wavelength_m=1", "live_demo: sensor.wavelength_m must be 1e-7 ... 2e-5"),
    ],
)
def test_wrong_setting_opens_no_window(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], setting: str, sentence: str
) -> None:
    opened = opened_benches(monkeypatch)
    assert run(monkeypatch, "live", "--set", setting) == 2
    assert not opened
    said = capsys.readouterr().err
    assert said.startswith(f"svwfs: {sentence}")
    assert said.count("\n") == 1


@pytest.mark.usefixtures("restored_theme", "runtime_folder")
def test_window_explains_a_wrong_file_with_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text("[sensor]\n")
    opened, bench = opened_benches(monkeypatch), tmp_path / "bench.toml"
    assert run(monkeypatch, "live", "--bench", bench, "--set", "registration.warp=affine") == 0
    assert opened == [str(bench)]

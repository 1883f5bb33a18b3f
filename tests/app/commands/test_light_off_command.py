"""`svwfs light-off`."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.command_line import run
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.pseudo_terminal import PtyServer
from support.watchdog_instrument import bench_toml


def test_light_off_switches_it_off(
    lamp_port: PtyServer,
    lamp: DC4100Wire,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bench = bench_toml(lamp_port.port, tmp_path)
    lamp.heads[0].is_on = True
    assert run(monkeypatch, "light-off", "--bench", bench) == 0
    assert not lamp.is_lit
    assert "LED1 is off" in capsys.readouterr().out


def test_light_that_cannot_be_reached_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "light-off", "--bench", bench_toml("/dev/null", tmp_path)) == 1
    said = capsys.readouterr().err
    assert said.startswith("svwfs: /dev/null cannot be opened")
    assert said.count("\n") == 1


@pytest.mark.parametrize(("driver", "status", "words"), [("simulated", 0, "nothing to"), ("manual", 1, "by hand")])
def test_light_off_without_a_light(
    driver: str,
    status: int,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(
        bench_toml("unused", tmp_path).read_text().partition("[light]")[0] + '[light]\ndriver = "manual"\n'
    )
    name = "small_demo" if driver == "simulated" else str(bench)
    assert run(monkeypatch, "light-off", "--bench", name) == status
    assert words in "".join(capsys.readouterr())

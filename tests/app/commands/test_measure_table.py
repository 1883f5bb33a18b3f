"""Tables on the terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.bench.config import load_bench
from app.commands.measure import print_measurement
from app.results.run_summary import Measured


@pytest.mark.parametrize("frames", [1, 2])
def test_scatter_is_printed_only_of_several_frames(frames: int, capsys: pytest.CaptureFixture[str]) -> None:
    bench = load_bench("small_demo")
    mean = np.full((bench.field.view_rows, bench.field.view_columns), 1.5)
    means = np.stack([mean, mean**2 + 0.1**2 / 2, np.full(mean.shape, 0.25**2)])
    measured = Measured(bench=bench, means=means, frames=frames, reconstructed=frames)
    print_measurement(measured, Path("run"))
    printed = " ".join(capsys.readouterr().out.split())
    assert "1.500" in printed
    assert f"1.500 +- {'0.100' if frames == 2 else '0.250'}" in printed
    assert "error bar of one frame: 0.250 rad;" in printed
    assert ("RMS (rad) of the wavefront +- error bar" in printed) == (frames == 1)
    assert ("mean +- scatter" in printed) == (frames == 2)
    assert f"{'1 frame' if frames == 1 else '2 frames'}, 0 lost" in printed


@pytest.mark.parametrize(("columns", "text"), [(160, "below noise (0.007 rad)"), (80, "(0.007 rad)")])
def test_rms_below_its_noise_is_no_number(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, columns: int, text: str
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    bench = load_bench("small_demo")
    mean = np.full((bench.field.view_rows, bench.field.view_columns), 1e-8)
    mean[0, 0] = 0.5
    print_measurement(
        Measured(bench=bench, means=np.stack([mean, mean**2, np.full_like(mean, 0.007**2)]), reconstructed=2),
        Path("run"),
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count(text) == printed.count("below noise") == mean.size - 1
    assert "0.500 +- 0.000" in printed

"""Tables on the terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.bench.config import load_bench
from app.cli.tables import print_measurement
from app.results.recording_results import Measured


@pytest.mark.parametrize("frames", [1, 2])
def test_scatter_is_printed_only_of_several_frames(frames: int, capsys: pytest.CaptureFixture[str]) -> None:
    bench = load_bench("small_demo")
    mean = np.full((bench.field.view_rows, bench.field.view_columns), 1.5)
    print_measurement(Measured(bench, mean, mean**2 + 0.01, recorded=frames, reconstructed=frames), Path("run"))
    printed = " ".join(capsys.readouterr().out.split())
    assert "1.500" in printed
    assert ("1.500 +- 0.100" in printed) == (frames == 2)
    assert ("mean +- scatter" in printed) == (frames == 2)
    assert f"{'1 frame' if frames == 1 else '2 frames'}, 0 lost" in printed

"""Other software on the same frames of a tiny bench: residuals, ratios, and missing packages."""

from __future__ import annotations

import pytest

from app.bench.config import load_bench
from studies import contestants as study
from studies.tables import Asked

SIZES = {"sensor.lenslet_rows": 5, "sensor.lenslet_columns": 5, "camera.rows": 155, "camera.columns": 155}
MIDDLE = {"lattice.center_x_px": 77.0, "lattice.center_y_px": 77.0}
COARSE = {"simulation.object_samples": 13, "simulation.pupil_samples": 10, "reconstruction.pupil_modes": 15}
CHANGES = {**SIZES, **MIDDLE, **COARSE, "simulation.screen.rms_rad": 2.0}


@pytest.mark.slow
def test_svwfs_measures_the_wavefront_better_than_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> study.Register:
        raise ImportError("No module named 'it'")

    monkeypatch.setitem(study.PEERS, "missing", missing)
    bench = load_bench("paper_simulation", tuple(f"{key}={value}" for key, value in CHANGES.items()))
    table, _ = study.contestants(Asked(bench), budget_s=0.02)
    found = table.set_index("by")
    for kind in ("noise_free_rad", "noisy_rad"):
        assert (found.loc[study.OURS, kind] < found.loc[list(study.RATIOS), kind]).all()
        assert (found.loc[list(study.RATIOS), kind] < 1.4).all()  # of more than 2
    assert (found.loc[list(study.RATIOS), "over_ours"] > 0).all()
    assert found.loc["scipy_splu", "over_ours"] > 0
    assert found.loc["missing", "problem"] == "ImportError: No module named 'it'"

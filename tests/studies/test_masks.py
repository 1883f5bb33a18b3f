"""Masks: predictions next to a full simulation, and many masks by prediction alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.bench.config import load_bench
from app.evaluation.mask_accuracy import predicted_accuracies
from studies.masks import mask, masks, named_mask
from studies.tables import Asked

pytestmark = pytest.mark.slow


def test_simulation_agrees_with_the_prediction_without_propagation(tmp_path: Path, small_toml: Path) -> None:
    y, x = np.mgrid[-1:1:60j, -1:1:60j]
    file = str(tmp_path / "four.npy")
    np.save(file, (np.hypot(abs(x) - 0.5, abs(y) - 0.5) > 0.3).astype(np.float32))
    bench = load_bench(small_toml, ("field.neglect_propagation=true",))
    found = mask(Asked(bench, masks=[file]), draws=20)[0].set_index(["curve", "at"])["mean_rad"]
    assert found["light over the square's", file] == pytest.approx(0.73, abs=0.01)  # 1 - 0.09 pi on 13 x 13 points
    for light in ("1000 e-", "1000 e- in the square"):
        simulated = found[f"noise, {light}: simulated", file]
        assert simulated == pytest.approx(found[f"noise, {light}: error bar", file], rel=0.15)
    assert found["residual, layers: simulated", file] < found["residual, any wavefront: simulated", file]


def test_many_masks_are_compared_as_each_is_predicted(tmp_path: Path, small_toml: Path) -> None:
    cells = (np.indices((5, 5)).sum(axis=0) % 2 == 0).astype(np.float32)
    np.save(tmp_path / "fine.npy", cells)
    np.save(tmp_path / "small.npy", np.pad(cells, 1))  # lights the view in the middle alone
    np.save(tmp_path / "between.npy", np.eye(9, dtype=np.float32)[[2]] * np.eye(9, 1, dtype=np.float32))  # the views
    bench = load_bench(small_toml)
    table, _ = masks(Asked(bench, masks=["checkerboard:5", str(tmp_path)]))
    table["mask"] = [Path(name).name for name in table["mask"]]
    found = table.set_index("mask")
    assert set(found.index) == {"checkerboard:5", "fine.npy", "small.npy", "square", "between.npy"}
    assert found["light"].isna().tolist() == [name == "between.npy" for name in found.index]
    named, picture = (found.loc[name].dropna().to_dict() for name in ("checkerboard:5", "fine.npy"))
    assert named == pytest.approx(picture, rel=1e-3)
    assert found.loc["small.npy", "bound_1000_rad"] > 1.5 * named["bound_1000_rad"]  # in all views
    alone = predicted_accuracies(named_mask(bench, "checkerboard:5"), lambda *_: None)["checkerboard"]
    for peak_e in (300, 1000, 10000):
        assert named[f"bound_{peak_e}_rad"] == pytest.approx(
            alone[f"noise, {peak_e} e- in the square: bound"], rel=1e-3
        )

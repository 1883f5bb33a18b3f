"""Residuals over the phase screen, and over sources, dead lenslets and wrong settings, on a tiny bench."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from app.bench.config import load_bench
from studies.screens import ensembles, experiment, roughness, size
from studies.tables import Asked
from studies.wrong_settings import dead, focal_length, lattice, source

pytestmark = pytest.mark.slow


@pytest.fixture
def asked(small_toml: Path) -> Asked:
    settings = ("simulation.source.mask='checkerboard'", "field.neglect_propagation=true")
    return Asked(load_bench(small_toml, settings))


def means(table: pd.DataFrame) -> pd.Series[float]:
    return table.set_index(["curve", "at"])["mean_rad"]


def test_richer_warps_and_refinement_leave_less_of_rough_screens(asked: Asked) -> None:
    found = means(roughness(asked, (1.25, 2.5))[0])
    assert found["affine", 2.5] < found["affine", 1.25]
    assert found["quadratic", 1.25] < found["affine", 1.25]
    assert found["quadratic refined", 1.25] < found["quadratic", 1.25]


def test_strong_wavefronts_leave_more(asked: Asked) -> None:
    found = means(size(asked, (0.5, 4.2))[0])
    assert found["affine", 0.5] < 0.5 * found["affine", 4.2]


def test_screen_near_the_mask_leaves_more_of_strong_wavefronts(asked: Asked) -> None:
    table, _ = experiment(asked, (1.0, 5.0))
    found = means(table)
    assert found["affine", 1.0] < found["affine", 5.0]
    assert (table["observations"] == 1).all()


def test_ensembles_have_every_solve_and_the_live_wavefront(asked: Asked) -> None:
    table, figure = ensembles(asked, (2.0,), ("quadratic",))
    found = means(table)
    solves = ["automatic", "layers", "live", "refined 3x", "refined live, 1 s old"]
    assert set(found.index.get_level_values("curve")) >= {f"quadratic, {each}" for each in ("zonal", *solves)}
    assert found["quadratic, refined 3x", 2.0] < found["quadratic, automatic", 2.0]
    assert found["quadratic, live", 2.0] == pytest.approx(found["quadratic, layers", 2.0], rel=0.01)
    assert found["quadratic, refined live, 1 s old", 2.0] == pytest.approx(
        found["quadratic, refined 3x", 2.0], rel=0.01
    )
    assert len(figure.axes) == 1


def test_views_inside_a_source_are_measured(asked: Asked) -> None:
    found = means(source(asked, ("circle",))[0])
    assert 0 < found["quadratic", "circle"] < found["affine", "circle"]


def test_wrong_lattice_is_worse_than_the_right_one(asked: Asked) -> None:
    found = means(lattice(asked, (0.0, 3.0))[0])
    for kind in ("pitch", "rotation"):
        assert found[f"{kind}: quadratic", 3.0] > 1.5 * found[f"{kind}: quadratic", 0.0]


def test_wrong_focal_length_is_worse_than_the_right_one(asked: Asked) -> None:
    found = means(focal_length(asked, (0.0, 0.05))[0])
    assert found["lenslets: cubic", 0.05] > 2 * found["lenslets: cubic", 0.0]


def test_dead_lenslets_are_lost_and_bridged(asked: Asked) -> None:
    table, _ = dead(asked, (0.0, 0.2))
    found = table.set_index(["curve", "at"])
    assert found.loc[("cubic refined", 0.0), "lost"] == 0
    assert found.loc[("cubic refined", 0.2), "lost"] == 7  # of 35
    assert found.loc[("cubic refined", 0.0), "mean_rad"] < found.loc[("cubic", 0.0), "mean_rad"]
    assert found.loc[("cubic refined, at the dead ones", 0.2), "mean_rad"] > 0

"""Frames and truth of another simulator (HCIPy, Fresnel propagation)."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile
from support.paths import FOREIGN_FRAMES

from app.bench.config import load_bench
from reconstruction.lattice.search import find_lattice
from reconstruction.pipeline import Reconstructor
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from reconstruction.wavefront import rms

FRAMES = FOREIGN_FRAMES
BENCH = load_bench(FRAMES / "bench.toml")
REFERENCE = tifffile.imread(FRAMES / "square_reference.tif")
FRAME = tifffile.imread(FRAMES / "square_frame.tif")
TRUTH = np.load(FRAMES / "truth.npz")["wavefront_rad"]


@pytest.mark.parametrize(
    ("warp", "method", "pupil_modes", "figure_rad"),
    [
        ("affine", "modal", 45, 0.20),
        ("affine", "zonal", 45, 0.21),
        ("quadratic", "modal", 66, 0.070),
        ("quadratic", "zonal", 66, 0.105),
    ],
)
def test_residual_against_truth_is_small(warp: str, method: str, pupil_modes: int, figure_rad: float) -> None:
    assert BENCH.lattice is not None
    reconstructor = Reconstructor(
        REFERENCE,
        sensor=BENCH.sensor,
        lattice=BENCH.lattice,
        field=BENCH.field,
        registration=RegistrationSettings(warp=warp),  # type: ignore[arg-type] # parametrised
        reconstruction=ReconstructionSettings(method=method, pupil_modes=pupil_modes),  # type: ignore[arg-type] # the same
    )
    wavefront = reconstructor(FRAME)
    assert wavefront.displacement.valid.all()
    assert rms(wavefront.views - TRUTH).mean() < figure_rad


def test_lattice_of_another_simulator_is_found() -> None:
    lattice = find_lattice(REFERENCE, BENCH.sensor)
    assert (lattice.center_x_px, lattice.center_y_px) == pytest.approx((255.5, 255.5), abs=0.02)
    assert lattice.pitch_px == pytest.approx(31.25, abs=0.005)
    assert lattice.rotation_rad == pytest.approx(0, abs=1e-4)

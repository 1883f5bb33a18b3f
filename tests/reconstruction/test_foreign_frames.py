"""Frames and truth of another simulator (HCIPy, Fresnel propagation), in the paper's world and in real light."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import tifffile
from support.paths import FOREIGN_FRAMES

from app.bench.config import load_bench
from app.bench.imaging_model import BenchModel, lenslet_model
from reconstruction.lattice.search import survey
from reconstruction.reconstructor import Reconstructor
from reconstruction.refinement import Refinement
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from reconstruction.wavefront import mean_rms, rms

FRAMES, REAL = FOREIGN_FRAMES, FOREIGN_FRAMES / "real_light"
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


@pytest.mark.slow
@pytest.mark.parametrize(("mask", "once_rad", "refined_rad"), [("square", 0.007, 0.007), ("checker", 0.005, 0.005)])
def test_layer_is_found_in_real_light(mask: str, once_rad: float, refined_rad: float) -> None:
    """With every setting omitted; the layer is 195 mm before the lenslets."""
    bench = load_bench(REAL / "bench.toml")
    reference, frame = (tifffile.imread(REAL / f"{mask}_{name}.tif") for name in ("reference", "frame"))
    truth = np.load(REAL / "truth.npz")["wavefront_rad"]
    assert bench.lattice is not None
    reconstructor = Reconstructor(
        reference,
        sensor=bench.sensor,
        lattice=bench.lattice,
        field=bench.field,
        registration=bench.registration,
        reconstruction=bench.reconstruction,
        lenslet_model=partial(lenslet_model, bench),
    )
    found = reconstructor(frame)
    assert found.displacement.valid.all()
    assert mean_rms(found.views - truth) < once_rad
    assert found.sample.ratios == pytest.approx((-0.975,), abs=0.005)
    *_, last = Refinement(reconstructor, BenchModel(bench, reconstructor)).rounds(found.displacement, 2, found.sample)
    assert mean_rms(last.wavefront.views - truth) < refined_rad


def test_lattice_of_another_simulator_is_found() -> None:
    lattice = survey(REFERENCE, BENCH.sensor).lattice
    assert (lattice.center_x_px, lattice.center_y_px) == pytest.approx((255.5, 255.5), abs=0.02)
    assert lattice.pitch_px == pytest.approx(31.25, abs=0.005)
    assert lattice.rotation_rad == pytest.approx(0, abs=1e-4)

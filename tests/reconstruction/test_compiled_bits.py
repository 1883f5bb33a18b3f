"""Code compiled in this process and code loaded from the cache give the same bits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import hashlib

import numpy as np

from app.bench.config import load_bench
from app.evaluation.frames import NoiseFreeFrames
from app.measurement.calibration import Calibration

bench = load_bench("small_demo")
frames, noise, made = NoiseFreeFrames(bench), np.random.default_rng(0), hashlib.sha256()
reference = frames.reference("square")
lattice = bench.design_lattice(*reference.shape)
reconstructor = Calibration.of_images(bench, reference, lattice=lattice).reconstructor()
photons = np.asarray(frames.frame("square").photons)
for _ in range(40):
    frame = noise.poisson(photons * (1000 / photons.max())) + noise.normal(0, 8, photons.shape)
    displacement = reconstructor.register(frame.astype(np.float32))
    made.update(displacement.coefficients.tobytes())
    made.update(displacement.residual_rms.tobytes())
print(made.hexdigest())
"""


@pytest.mark.slow
@pytest.mark.long
def test_compiled_and_cached_code_give_the_same_bits(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}

    def bits() -> str:
        command = [sys.executable, "-c", PROGRAM]
        return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout  # noqa: S603 - our own command

    compiled, cached = bits(), bits()
    assert compiled == cached
    outermost = list(tmp_path.rglob("*fit_lenslets*"))
    assert outermost
    for path in outermost:
        path.unlink()
    assert bits() == compiled

"""Noise-free frames of a simulated bench."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.bench.config import load_bench
from app.evaluation.frames import NoiseFreeFrames


def test_noise_free_frames_are_reproducible_and_conserve_light(small_toml: Path) -> None:
    bench = load_bench(small_toml, ("field.neglect_propagation=true",))  # else light leaves and enters the lattice
    frames = NoiseFreeFrames(bench)
    frame, again = frames.frame("square"), NoiseFreeFrames(bench).frame("square")
    assert np.array_equal(frame.photons, again.photons)
    assert np.array_equal(frame.truth, again.truth)
    assert frame.truth.shape == (3, 3, 5, 7)
    assert frames.reference("square").sum() == pytest.approx(frame.photons.sum(), rel=0.01)

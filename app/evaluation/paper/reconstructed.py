"""Wavefronts of a method from a pair of frames, cached by everything they depend on."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

import reconstruction
from app.bench.config import Bench, write_bench
from app.cache import Arrays, cached
from app.evaluation.paper.frames import Frames
from app.evaluation.paper.methods import Method
from reconstruction.arrays import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Reconstructed:
    """The wavefronts of one frame by one method."""

    views: Floats  # rad, (view_row, view_column, lenslet_row, lenslet_column)
    lost: int  # lenslets without a displacement
    seconds: float  # for the frame, without preparing the reference


def reconstructed(bench: Bench, frames: Mapping[str, Frames], method: Method) -> Reconstructed:
    """Reconstruct the frame of the method's mask; a changed frame, setting or reconstruction package recomputes."""
    pair, stars = frames[method.mask], bench.simulation.source
    registration = replace(
        method.registration,
        star_rows=stars.star_rows,
        star_columns=stars.star_columns,
        star_spacing_m=stars.star_spacing_m,
    )
    bench = replace(bench, registration=registration, reconstruction=method.reconstruction)
    kept = cached("paper", _fingerprint(bench, pair), lambda: _reconstruct(bench, pair))
    return Reconstructed(kept["views"], int(kept["lost"]), float(kept["seconds"]))


def _reconstruct(bench: Bench, pair: Frames) -> Arrays:
    """Return the fields of `Reconstructed`."""
    lattice = bench.design_lattice(*pair.reference.shape)
    reconstructor = bench.reconstructor(pair.reference, lattice=lattice, dark=np.zeros_like(pair.reference))
    start_s = time.perf_counter()
    wavefront = reconstructor(pair.frame)
    seconds = time.perf_counter() - start_s
    lost = np.count_nonzero(~wavefront.displacement.valid)
    return {"views": wavefront.views, "lost": np.array(lost), "seconds": np.array(seconds)}


def _fingerprint(bench: Bench, pair: Frames) -> str:
    digest = hashlib.sha256(write_bench(bench).encode())
    digest.update(_source_code())
    digest.update(pair.reference.tobytes())
    digest.update(pair.frame.tobytes())
    return digest.hexdigest()


@cache
def _source_code() -> bytes:
    """The source code of `reconstruction`."""
    folder = Path(str(reconstruction.__file__)).parent
    return b"".join(path.read_bytes() for path in sorted(folder.rglob("*.py")))

"""What each method makes of the same frames: wavefronts of the views, remembered by everything they depend on."""

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
from app.cache import Arrays, remembered
from app.evaluation.paper.frames import Frames
from app.evaluation.paper.methods import Method
from reconstruction.arrays import Floats
from reconstruction.wavefront import rms


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """The wavefronts that a method finds."""

    views: Floats  # rad, (view_row, view_column, lenslet_row, lenslet_column)
    lost: int  # lenslets without a displacement
    seconds: float  # for one frame, the reference already prepared

    def residual_rms(self, truth: Floats) -> Floats:
        """RMS over the lenslets of measured minus true, of each view: (view_row, view_column), rad."""
        return rms(self.views - truth)


def measured(bench: Bench, frames: Mapping[str, Frames], method: Method) -> Measured:
    """Reconstruct with one method; what the same code of `reconstruction` made of the same frames is remembered."""
    pair, stars = frames[method.mask], bench.simulation.source
    registration = replace(
        method.registration,
        star_rows=stars.star_rows,
        star_columns=stars.star_columns,
        star_spacing_m=stars.star_spacing_m,
    )
    bench = replace(bench, registration=registration, reconstruction=method.reconstruction)
    kept = remembered("paper", _fingerprint(bench, pair), lambda: _measure(bench, pair))
    return Measured(kept["views"], int(kept["lost"]), float(kept["seconds"]))


def _measure(bench: Bench, pair: Frames) -> Arrays:
    """Return the fields of `Measured`."""
    lattice = bench.design_lattice(*pair.reference.shape)
    reconstructor = bench.reconstructor(pair.reference, lattice=lattice, dark=np.zeros_like(pair.reference))
    start_s = time.perf_counter()
    wavefront = reconstructor(pair.frame)
    seconds = time.perf_counter() - start_s
    lost = np.count_nonzero(~wavefront.displacement.valid)
    return {"views": wavefront.views, "lost": np.array(lost), "seconds": np.array(seconds)}


def _fingerprint(bench: Bench, pair: Frames) -> str:
    digest = hashlib.sha256(write_bench(bench).encode())
    digest.update(_code())
    digest.update(pair.reference.tobytes())
    digest.update(pair.frame.tobytes())
    return digest.hexdigest()


@cache
def _code() -> bytes:
    """The text of the package that computes, so that no result outlives its method."""
    folder = Path(str(reconstruction.__file__)).parent
    return b"".join(path.read_bytes() for path in sorted(folder.rglob("*.py")))

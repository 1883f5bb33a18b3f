"""Reconstruction of frames that are arrays, with refinement by the bench's forward model."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.measurement.imaging_model import BenchModel
from reconstruction.arrays import Counts
from reconstruction.lattice.search import find_lattice
from reconstruction.refinement import Refinement, Round
from reconstruction.wavefront import Wavefront


class BenchReconstructor:
    """Turns frames of one bench into wavefronts; everything that depends on the reference is prepared once.

    Parameters
    ----------
    bench
        The bench. Without a lattice of its own, the lattice is found in the reference.
    reference
        Frame without the sample, (row, column), counts.
    dark
        Frame without light, (row, column), counts. Without one, the darkest percent of each image is the background.
    full_scale
        Count at which a pixel saturates; by default that of the camera's bits and of the reference's integers.

    Raises
    ------
    ReconstructionError
        If the reference shows no lattice or cannot be used; the message says why.
    """

    def __init__(
        self, bench: Bench, reference: Counts, *, dark: Counts | None = None, full_scale: float | None = None
    ) -> None:
        lattice = bench.lattice or find_lattice(reference, bench.sensor)
        self.bench = replace(bench, lattice=lattice)
        self._reconstructor = bench.reconstructor(
            reference,
            lattice=lattice,
            dark=dark,
            full_scale=full_scale_of(reference, bench.camera_model.bits) if full_scale is None else full_scale,
        )

    def __call__(self, frame: Counts) -> Wavefront:
        """Return the wavefront of a frame (row, column), counts; `ReconstructionError` says why there is none."""
        return self._reconstructor(frame)

    def rounds(self, frame: Counts, most: int) -> Iterator[Round]:
        """Refine the wavefront of a frame (row, column), counts, in at most `most` rounds; fewer where it settles."""
        return self._refinement.rounds(self._reconstructor.register(frame), most)

    @cached_property
    def _refinement(self) -> Refinement:
        return Refinement(self._reconstructor, BenchModel(self.bench, self._reconstructor))


def full_scale_of(image: NDArray[Any], bits: int) -> float:
    """Count at which a camera of so many bits saturates, or at which the image's integers do."""
    return min(2.0**bits, np.iinfo(image.dtype).max + 1.0 if image.dtype.kind in "ui" else np.inf) - 1

"""The calibration: all that the reconstructor is made of, so that it can be made again, bit for bit.

A `Calibration` is in force until a dark, a reference or a setting changes; then there is another one. Each frame
carries the one it was reconstructed with, and a recording keeps every one that its frames name.
"""

from __future__ import annotations

from dataclasses import dataclass

from app.bench.config import Bench
from app.measurement.routines import Average
from reconstruction.frame.noise import CameraNoise, photon_transfer
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey, survey
from reconstruction.pipeline import Reconstructor


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A bench with the dark, the reference and the lattice in force."""

    bench: Bench
    dark: Average | None
    reference: Average
    lattice: Lattice  # the bench's, or as found in the reference
    full_scale: float  # the count at which a pixel saturates

    @classmethod
    def of(cls, bench: Bench, dark: Average | None, reference: Average, full_scale: float) -> Calibration:
        """Find the lattice in the reference unless the bench says where it is; `ReconstructionError` if there is none.

        This is the only step that need not be done again for a calibration that was kept.
        """
        lattice = bench.lattice or surveyed(bench, dark, reference, full_scale).lattice
        return cls(bench, dark, reference, lattice, full_scale)

    def reconstructor(self) -> Reconstructor:
        """Make the reconstructor; raises `ReconstructionError` when dark, reference and settings do not allow it."""
        return self.bench.reconstructor(
            self.reference.mean,
            lattice=self.lattice,
            dark=None if self.dark is None else self.dark.mean,
            full_scale=self.full_scale,
            noise=self.noise(),
            reference_frames=self.reference.frames,
        )

    def noise(self) -> CameraNoise | None:
        """The camera's noise, from the scatter of the frames that made dark and reference; None without a dark."""
        dark, reference = self.dark, self.reference
        if dark is None or dark.mean.shape != reference.mean.shape:  # the latter is refused by whoever uses both
            return None
        return photon_transfer(
            reference.mean - dark.mean, reference.variance, frames=reference.frames, dark_variance=dark.variance
        )


def surveyed(bench: Bench, dark: Average | None, reference: Average, full_scale: float) -> Survey:
    """Look where the lenslets lie on the reference, whatever the bench says; `ReconstructionError` if it shows none."""
    return survey(reference.mean, bench.sensor, dark=None if dark is None else dark.mean, full_scale=full_scale)

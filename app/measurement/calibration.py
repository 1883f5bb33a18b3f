"""Calibration: everything from which a reconstructor is rebuilt bit by bit.

A new dark, reference or setting makes a new `Calibration`. Each measurement refers to its own, and a recording stores
all that its frames refer to.
"""

from __future__ import annotations

from dataclasses import dataclass

from app.bench.config import Bench
from app.cache import kept_for_bench
from app.measurement.judging import frame_judge
from app.measurement.routines.averages import Average
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise, TransferCurve, photon_transfer
from reconstruction.geometry import Lattice, Sensor
from reconstruction.lattice.search import Survey, survey
from reconstruction.pipeline import Reconstructor
from reconstruction.quality.frame_quality import FrameJudge


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A bench with its dark, reference and lattice."""

    bench: Bench
    dark: Average | None
    reference: Average
    lattice: Lattice  # configured, or found in the reference
    full_scale: float  # saturation level, counts

    @classmethod
    def of(cls, bench: Bench, dark: Average | None, reference: Average, full_scale: float) -> Calibration:
        """Find the lattice in the reference unless it is configured; `ReconstructionError` if it shows none."""
        lattice = bench.lattice or surveyed(bench, dark, reference, full_scale).lattice
        return cls(bench, dark, reference, lattice, full_scale)

    def reconstructor(self) -> Reconstructor:
        """Build the reconstructor; `ReconstructionError` if dark, reference and settings do not fit."""
        return self.bench.reconstructor(
            self.reference.mean,
            lattice=self.lattice,
            dark=None if self.dark is None else self.dark.mean,
            full_scale=self.full_scale,
            noise=self.noise(),
            reference_frames=self.reference.frames,
        )

    def judge(self, reconstructor: Reconstructor) -> FrameJudge:
        """Judge the calibration, and prepare the judgement of frames reconstructed by `reconstructor`."""
        dark, reference = self.dark, self.reference
        shown = None
        if self.bench.lattice is not None:
            shown = _shown_lattice(dark, reference, self.bench.sensor, self.full_scale)
        return frame_judge(
            reconstructor,
            reference.mean,
            shown=shown,
            dark=None if dark is None else dark.mean,
            variance=reference.variance,
            frames=reference.frames,
            curve=self._transfer(),
        )

    def noise(self) -> CameraNoise | None:
        """Camera noise from the scatter of the averaged frames; None without a dark."""
        curve = self._transfer()
        return None if curve is None else curve.noise

    def _transfer(self) -> TransferCurve | None:
        """Variance of the averaged frames against their light; None without a dark."""
        dark, reference = self.dark, self.reference
        if dark is None or dark.mean.shape != reference.mean.shape:  # refused by `reconstructor`
            return None
        return photon_transfer(
            reference.mean - dark.mean, reference.variance, frames=reference.frames, dark_variance=dark.variance
        )


@kept_for_bench(maxsize=4)  # another setting does not change it
def _shown_lattice(dark: Average | None, reference: Average, sensor: Sensor, full_scale: float) -> Lattice | None:
    """The lattice that the reference shows; None if it shows none."""
    try:
        mean = None if dark is None else dark.mean
        return survey(reference.mean, sensor, dark=mean, full_scale=full_scale).lattice
    except ReconstructionError:
        return None


def surveyed(bench: Bench, dark: Average | None, reference: Average, full_scale: float) -> Survey:
    """Find the lenslets in the reference, ignoring the configured lattice; `ReconstructionError` if it shows none."""
    return survey(reference.mean, bench.sensor, dark=None if dark is None else dark.mean, full_scale=full_scale)

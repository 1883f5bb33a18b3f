"""Calibration: everything from which an estimator is rebuilt.

A new dark, reference or setting makes a new `Calibration`. Each measurement refers to its own, and a recording stores
all that its frames refer to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from app.bench.config import Bench
from app.bench.imaging_model import lenslet_model
from app.cache import kept_while_alive
from app.measurement.averages import Average
from reconstruction.arrays import Booleans, Counts
from reconstruction.frame.bad_pixels import find_bad_pixels, repaired
from reconstruction.frame.noise import KnownNoise, TransferCurve, image_transfer, photon_transfer
from reconstruction.frame.pixels import KnownCamera
from reconstruction.geometry import Lattice, Sensor
from reconstruction.lattice.search import Survey, survey
from reconstruction.quality.reference_quality import lit_lenslets
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.reconstructor import NO_OWN, OwnMethods, Reconstructor


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True, kw_only=True)
class Calibration:
    """A bench with its dark, reference and lattice."""

    bench: Bench  # with the numbers of lenslets
    dark: Average | None
    reference: Average
    lattice: Lattice  # configured, or found in the reference
    full_scale: float  # saturation level, counts
    known: KnownNoise | None = None  # None: that of the scatter of the averaged frames
    own: OwnMethods = NO_OWN

    @classmethod
    def of(
        cls,
        bench: Bench,
        reference: Average,
        *,
        dark: Average | None,
        full_scale: float,
        lattice: Lattice | None = None,
        known: KnownNoise | None = None,
    ) -> Calibration:
        """Find lattice and pupil, unless known, in the reference; `ReconstructionError` if it shows none."""
        lattice = lattice or bench.lattice
        if lattice is None:
            found = surveyed(bench.sensor, reference, dark=dark, full_scale=full_scale)
            bench, lattice = replace(bench, sensor=found.sensor), found.lattice
        light, background = reference.mean, _dark_like(reference.mean, dark)
        lit = lit_lenslets(light - (light.min() if background is None else background), lattice, bench.sensor)
        bench = replace(bench, sensor=bench.sensor.with_pupil(lit))
        return cls(bench=bench, dark=dark, reference=reference, lattice=lattice, full_scale=full_scale, known=known)

    @classmethod
    def of_images(
        cls,
        bench: Bench,
        reference: Counts,
        *,
        dark: Counts | None = None,
        lattice: Lattice | None = None,
        full_scale: float = math.inf,
    ) -> Calibration:
        """Take a reference and a dark, (row, column), whose noise is unknown, and a `lattice` if it is known."""
        lit, unlit = Average.of_image(reference), None if dark is None else Average.of_image(dark)
        return cls.of(bench, lit, dark=unlit, full_scale=full_scale, lattice=lattice, known=KnownNoise())

    @property
    def dark_image(self) -> Counts | None:
        """Mean of the dark, (row, column), counts; None without one."""
        return None if self.dark is None else self.dark.mean

    @property
    def noise(self) -> KnownNoise:
        """Noise as known, or found in dark and reference, which without a dark do not show it."""
        if self.known is not None:
            return self.known
        dark, reference, curve = self.dark, self.reference, None
        if dark is not None and dark.mean.shape == reference.mean.shape:  # `reconstructor` refuses another
            light, variance, frames = reference.mean - dark.mean, reference.variance, reference.frames
            if (linearity := self.bench.linearity) is not None:  # of the light, as frames have it
                light, variance = linearity.light(light), variance * linearity.slope(light) ** 2
            curve = photon_transfer(light, variance, frames=frames, dark_variance=dark.variance)
        return KnownNoise(None if curve is None else curve.noise, reference.frames, curve)

    def transfer_of(self, image: Counts) -> TransferCurve | None:
        """Photon transfer curve of a single image (row, column), counts; None if it shows none."""
        dark = _dark_like(image, self.dark)
        light = np.subtract(image, np.min(image) if dark is None else dark, dtype=np.float32)
        if (linearity := self.bench.linearity) is not None:
            light = np.asarray(linearity.light(light), np.float32)
        bad = _bad_pixels(self.reference, self.dark, self.bench.sensor.blur_px)
        return image_transfer(repaired(light, bad) if light.shape == bad.shape else light, self.bench.sensor.blur_px)

    @property
    def camera(self) -> KnownCamera:
        """Camera that turns the counts of reference and frames into light."""
        return KnownCamera(self.dark_image, self.full_scale, self.bench.linearity, self.noise)

    @property
    def linearity_quality(self) -> Quality:
        """Judge whether the camera is in the mode in which its nonlinearity was measured."""
        measured, reference = self.bench.linearity, self.reference
        if measured is None or not measured.amplifier or not reference.amplifier:
            return Quality()
        if (measured.amplifier, measured.em_gain) == (reference.amplifier, reference.em_gain):
            return Quality()
        why = (
            f"the nonlinearity was measured with amplifier {measured.amplifier} and gain {measured.em_gain:g}: measure"
            " it again (svwfs calibrate --linearity), or remove [linearity]"
        )
        return Quality.of(Fault.LINEARITY, why)

    def reconstructor(self) -> Reconstructor:
        """Build the reconstructor once; `ReconstructionError` if dark, reference and settings do not fit."""
        made: Reconstructor = _reconstructor(self)
        return made


@kept_while_alive(maxsize=2)
def _reconstructor(calibration: Calibration) -> Reconstructor:
    bench = calibration.bench
    return Reconstructor(
        calibration.reference.mean,
        sensor=bench.sensor,
        lattice=calibration.lattice,
        field=bench.field,
        registration=bench.registration,
        reconstruction=bench.reconstruction,
        camera=calibration.camera,
        own=calibration.own,
        lenslet_model=partial(lenslet_model, bench),
    )


def surveyed(sensor: Sensor, reference: Average, *, dark: Average | None, full_scale: float) -> Survey:
    """Find the lenslets in a reference; `ReconstructionError` if it shows none."""
    return survey(reference.mean, sensor, dark=None if dark is None else dark.mean, full_scale=full_scale)


@kept_while_alive(maxsize=4)  # each image is judged with them
def _bad_pixels(reference: Average, dark: Average | None, blur_px: float) -> Booleans:
    """Find the bad pixels (row, column)."""
    return find_bad_pixels(reference.mean, _dark_like(reference.mean, dark), blur_px=blur_px)


def _dark_like(image: Counts, dark: Average | None) -> Counts | None:
    """Return the dark, (row, column), counts; None if it has another size, for which it is refused later."""
    return None if dark is None or dark.mean.shape != image.shape else dark.mean

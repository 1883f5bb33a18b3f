"""What a dark or a reference was taken under, and whether that still holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.interface import Devices, Region

_SAME_EXPOSURE = 1e-3  # relative


@dataclass(frozen=True, slots=True)
class Circumstances:
    """How the devices stand, as far as an average of frames goes only with frames of the same.

    The light's current is not part of it: what the registration compares may be of any brightness.
    """

    exposure_s: float
    amplifier: str
    em_gain: float
    readout_speed: int
    binning: int
    region: Region
    mask: str

    @classmethod
    def of(cls, devices: Devices) -> Circumstances:
        """Ask camera and stage."""
        camera = devices.camera
        return cls(
            exposure_s=camera.exposure_s,
            amplifier=camera.amplifier,
            em_gain=camera.em_gain,
            readout_speed=camera.readout_speed,
            binning=camera.binning,
            region=camera.region,
            mask=devices.stage.mask,
        )

    def shows_same_pixels(self, now: Circumstances) -> bool:
        """Whether its frames have the same pixels of the sensor as those of now."""
        return (self.region, self.binning) == (now.region, now.binning)

    def differs(self, now: Circumstances, *, is_lit: bool) -> str:
        """What of it has changed, by the words after "was taken"; empty if nothing. Only what `is_lit` shows the mask.

        What spoils more comes first.
        """
        if not self.shows_same_pixels(now):
            return "of another part of the sensor, or with another binning"
        if is_lit and self.mask != now.mask:
            return f"with the mask {self.mask}"
        if (self.amplifier, self.em_gain) != (now.amplifier, now.em_gain):
            return "with another amplifier or gain"
        if self.readout_speed != now.readout_speed:
            return f"with readout speed {self.readout_speed}"
        if not np.isclose(self.exposure_s, now.exposure_s, rtol=_SAME_EXPOSURE):
            return f"at {self.exposure_s * 1e3:.1f} ms"
        return ""

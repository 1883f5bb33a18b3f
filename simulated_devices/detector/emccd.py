"""An electron-multiplying CCD: from the mean number of photons to the counts of one frame.

photons -> quantum efficiency, shot noise, dark current and clock-induced charge -> full well -> multiplication
register, when its gain is above 1 -> read noise -> offset -> converter.
The random numbers of a pixel are hashes of (seed, frame, pixel): a frame does not depend on threads or on the frames
before it.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from simulated_devices.detector.pixel_noise import expose_rows, splitmix64

if TYPE_CHECKING:
    from simulated_devices.settings import Amplifier, SimulatedCameraSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """Settings of one frame."""

    index: int
    exposure_s: float
    amplifier: Amplifier
    em_gain: float
    readout_speed: int  # of the EM amplifier


class Detector:
    """The sensor chip and its read-out; two threads share the rows of a frame."""

    _THREADS = 2

    def __init__(self, settings: SimulatedCameraSettings, *, seed: int) -> None:
        self._settings = settings
        self._seed = seed
        self._pool = ThreadPoolExecutor(self._THREADS, thread_name_prefix="detector")

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def read_noise_e(self, amplifier: Amplifier, readout_speed: int) -> float:
        """Standard deviation of the read-out noise in electrons after the multiplication."""
        if amplifier == "normal":
            return self._settings.normal_read_noise_e
        return self._settings.em_read_noise_e[readout_speed - 1]

    def counts(self, photons: NDArray[np.float32], exposure: Exposure) -> NDArray[np.uint16]:
        """Counts of one frame, (row, column), from the mean photons on each pixel during the exposure."""
        edges = [len(photons) * part // self._THREADS for part in range(self._THREADS + 1)]
        counts = np.empty(photons.shape, np.uint16)
        jobs = [
            self._pool.submit(self._expose, photons, exposure, start, end, counts) for start, end in pairwise(edges)
        ]
        for job in jobs:
            job.result()
        return counts

    def begin(self, photons: Callable[[], NDArray[np.float32]], exposure: Exposure) -> Future[NDArray[np.uint16]]:
        """Begin to compute the counts of a frame in one thread; `photons` is called there."""
        return self._pool.submit(self._counts_in_one_thread, photons, exposure)

    def _counts_in_one_thread(
        self, photons: Callable[[], NDArray[np.float32]], exposure: Exposure
    ) -> NDArray[np.uint16]:
        received = photons()
        counts = np.empty(received.shape, np.uint16)
        self._expose(received, exposure, 0, len(received), counts)
        return counts

    def _expose(
        self, photons: NDArray[np.float32], exposure: Exposure, start: int, end: int, counts: NDArray[np.uint16]
    ) -> None:
        """Fill rows start ... end of the counts."""
        settings = self._settings
        background_e = settings.dark_current_e_per_s * exposure.exposure_s + settings.clock_induced_charge_e
        parameters = np.array(
            [
                settings.quantum_efficiency,
                background_e,
                settings.full_well_e,
                exposure.em_gain if exposure.amplifier == "em" else 1.0,
                settings.register_full_well_e,
                self.read_noise_e(exposure.amplifier, exposure.readout_speed),
                1 / settings.electrons_per_count,
                settings.offset_counts,
                2**settings.bits - 1,
            ],
            np.float32,
        )
        hashed_seed = int(splitmix64(np.uint64(self._seed)))  # Numba returns it as Python's integer
        key = np.uint64(splitmix64(np.uint64((hashed_seed + exposure.index) % 2**64)))
        expose_rows(photons, key, parameters, start, end, counts)

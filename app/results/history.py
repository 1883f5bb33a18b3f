"""History of a running measurement: named series on a common time axis, bounded in memory."""

import math
from collections.abc import Mapping

import numpy as np

from app.measurement.measurement import Measurement
from reconstruction.arrays import Floats
from reconstruction.wavefront import Wavefront, mean_rms

RMS, FILL, DELAY, TEMPERATURE = "RMS", "Exposure", "Delay", "Temperature"
UNITS = {FILL: "% of full scale", DELAY: "ms", TEMPERATURE: "\N{DEGREE SIGN}C"}  # the others are phases, rad
_CALM_S = 2.0  # within its limit, until a series is back


def drift(values: Floats) -> tuple[float, float, float]:
    """Return mean, standard deviation and peak to peak of values (time,), without the gaps; NaN if unknown."""
    known = values[np.isfinite(values)]
    if not known.size:
        return math.nan, math.nan, math.nan
    sigma = float(np.std(known, ddof=1)) if known.size > 1 else math.nan
    return float(np.mean(known)), sigma, float(np.ptp(known))


class LimitWatch:
    """Tells once when a series crosses its limit, and once when it is back for two seconds or has another limit."""

    def __init__(self) -> None:
        self.beyond: dict[str, tuple[float, float]] = {}  # series; when it was last beyond which limit, s

    def follow(
        self, time_s: float, values: Mapping[str, float], limits: Mapping[str, float]
    ) -> tuple[list[str], list[str]]:
        """Compare the values of a time; return the series that have crossed, and those that are back."""
        self.beyond = {name: last for name, last in self.beyond.items() if name in limits}
        crossed, back = [], []
        for name, limit in limits.items():
            value = values.get(name, math.nan)
            if abs(value) > limit:
                crossed += [name] * (name not in self.beyond)
                self.beyond[name] = time_s, limit
            elif math.isfinite(value) and name in self.beyond:
                last_s, before = self.beyond[name]
                if abs(time_s - last_s) >= _CALM_S or limit != before:
                    del self.beyond[name]
                    back.append(name)
        return crossed, back


class History:
    """The last `capacity` samples of `most_series` series; a new one replaces the longest unused."""

    def __init__(self, capacity: int = 6000, most_series: int = 12) -> None:
        """Hold 20 minutes at five samples a second by default."""
        self._capacity, self._most = capacity, most_series
        self._time_s = np.full(capacity, np.nan)
        self._series: dict[str, Floats] = {}
        self._count = 0

    def add(self, time_s: float, values: dict[str, float]) -> None:
        """Add one sample at a rising time; a series that has none is NaN there."""
        at = self._count % self._capacity
        self._time_s[at] = time_s
        for series in self._series.values():
            series[at] = np.nan
        for name, value in values.items():
            if name not in self._series and len(self._series) >= self._most:
                del self._series[next(iter(self._series))]
            series = self._series.pop(name) if name in self._series else np.full(self._capacity, np.nan)
            series[at] = value
            self._series[name] = series  # last: the first is the one unused for longest
        self._count += 1

    def series(self, name: str) -> tuple[Floats, Floats]:
        """Return times before the newest sample, s, negative, and values, NaN in gaps; empty without any."""
        if name not in self._series:
            return np.zeros(0), np.zeros(0)
        at = np.arange(max(self._count - self._capacity, 0), self._count) % self._capacity
        return self._time_s[at] - self._time_s[at[-1]], self._series[name][at]

    def table(self) -> tuple[list[str], Floats]:
        """Return heads and rows of all series: seconds since the first sample, phases in rad, NaN in gaps."""
        at = np.arange(max(self._count - self._capacity, 0), self._count) % self._capacity
        time_s = self._time_s[at] - self._time_s[at[:1]]
        columns = [time_s, *(series[at] for series in self._series.values())]
        names = ["time (s)", *(f"{name} ({UNITS.get(name, 'rad')})" for name in self._series)]
        return names, np.c_[*columns]

    def forget(self, name: str) -> None:
        """Drop a series."""
        self._series.pop(name, None)


def sample(
    measurement: Measurement, shown: Wavefront | None, *, full_scale: float, temperature_c: float | None
) -> tuple[float, dict[str, float]]:
    """Return the time of a frame, s, and the series of every frame: RMS, fill, delay, temperature."""
    values = {DELAY: measurement.latency_s * 1e3}
    if full_scale:
        values[FILL] = 100 * float(measurement.frame.pixels.max()) / full_scale
    if temperature_c is not None:
        values[TEMPERATURE] = temperature_c
    if shown is not None and np.isfinite(mean_rad := mean_rms(shown.views)):
        values[RMS] = mean_rad
    return measurement.frame.host_time_s, values

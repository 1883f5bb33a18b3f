"""A frame in a straight line: from the camera through the instrument to everybody who takes or looks at results."""

from __future__ import annotations

import time
from collections.abc import Callable

from app.acquisition.arrivals import Arrivals
from app.acquisition.instrument import Instrument, Reconstruction
from app.measurement.measurement import Counts, LightState, Measurement
from app.measurement.routines import next_frame
from app.timing import Timings
from drivers.interface import DeviceTimeout, Frame, FrameLost

_PASSING_OVER_S = 0.5  # and no longer, where frames come faster than they can be passed over
_OLD_S = 0.1  # a frame that is older, and there are newer ones, is not reconstructed


class FramePath:
    """Takes frames and passes on what becomes of them: to the sinks every one, to the mailbox the newest."""

    def __init__(
        self,
        sinks: tuple[Callable[[Measurement], None], ...],
        timings: Timings,
        is_wanted: Callable[[Instrument], bool],
    ) -> None:
        """`is_wanted` says, ten times a second, whether there is something else to do than to wait for a frame."""
        self._sinks, self._timings, self._is_wanted = sinks, timings, is_wanted
        self._arrivals = Arrivals()
        self.newest: Measurement | None = None  # the mailbox: written by one thread, read by anybody

    @property
    def counts(self) -> Counts:
        """What has become of the frames so far."""
        return self._arrivals.counts

    def acquire(self, instrument: Instrument, light: LightState | None) -> None:
        """Take one frame, reconstruct it and pass it on; `Cancelled` when something else is to be done."""
        frame = self._newest_frame(instrument, light)
        made = instrument.measure(frame)
        if made.wavefront is not None:
            self._arrivals.count_reconstructed()
        measurement = self._measurement(frame, made, light)
        self._timings.note("to_result", measurement.latency_s)
        with self._timings.of("publish"):
            self._publish(measurement)
            self.newest = measurement

    def show(self, frame: Frame, text: str, light: LightState | None) -> None:
        """Let a frame be seen, with a text in place of a wavefront; it is neither measured nor counted."""
        self._arrivals.set_clock(frame)
        self.newest = self._measurement(frame, Reconstruction(None, text), light)

    def _newest_frame(self, instrument: Instrument, light: LightState | None) -> Frame:
        """Wait for a frame; when it has lain in the camera for long, pass it over for the newest that is there."""
        camera, start_s = instrument.devices.camera, time.perf_counter()
        frame = next_frame(camera, lambda: self._is_wanted(instrument))
        arrived_s = max(frame.host_time_s, start_s)  # it may have lain in the camera already
        self._timings.note("wait", arrived_s - start_s)
        self._timings.note("copy", time.perf_counter() - arrived_s)
        self._arrivals.count(frame)
        if self._arrivals.age_s(frame) > max(_OLD_S, 2 * frame.exposure_s):
            while not self._is_wanted(instrument) and time.perf_counter() < arrived_s + _PASSING_OVER_S:
                try:
                    newer = camera.read(0.0)
                except (DeviceTimeout, FrameLost):  # there is none; whatever another device says is not the camera's
                    break
                self._publish(self._measurement(frame, instrument.pass_over(frame), light))
                frame = newer
                self._arrivals.count(frame)
        return frame

    def _publish(self, measurement: Measurement) -> None:
        for sink in self._sinks:
            sink(measurement)

    def _measurement(self, frame: Frame, made: Reconstruction, light: LightState | None) -> Measurement:
        exposure_end_s = self._arrivals.exposure_end_s(frame)
        return Measurement(
            frame,
            made.wavefront,
            made.problem,
            self._arrivals.counts,
            exposure_end_s,
            latency_s=time.perf_counter() - exposure_end_s,
            refinement=made.refinement,
            calibration=made.calibration,
            start=made.start,
            registered=made.registered,
            light=light,
        )

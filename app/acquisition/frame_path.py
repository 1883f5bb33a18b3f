"""Path of a frame from the camera, or a file, through the instrument to the sinks and the mailbox."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from app.acquisition.instrument import Instrument
from app.errors import InputError
from app.images import read_image
from app.measurement.measurement import FrameTotals, Gap, LightState, Measurement
from app.measurement.routines import next_frame
from app.timing import Timings
from drivers.interface import Camera, DeviceTimeout, Frame, FrameLost

_SKIPPING_S = 0.5  # time limit for skipping frames that arrive faster than they can be skipped
_CLOCK_DRIFT = 5e-4  # rate of the camera's clock relative to this computer's, at most
_OLD_S = 0.1  # an older frame is skipped if there is a newer one

Sink: TypeAlias = Callable[[Measurement], object]  # receives measurements


class FramePath:
    """Reads and reconstructs frames; every result goes to the sinks, the newest to the mailbox."""

    def __init__(
        self,
        sinks: tuple[Sink, ...],
        timings: Timings,
        must_stop_waiting: Callable[[Instrument], bool],
        on_show: Sink = lambda _: None,
    ) -> None:
        """`must_stop_waiting` is polled every 5 ms in a wait for a frame; `on_show` receives the frames of `show`."""
        self.sinks, self._timings, self._must_stop_waiting = sinks, timings, must_stop_waiting
        self._on_show = on_show
        self.measured_in_s = 0.0  # time that the last frame took
        self.newest: Measurement | None = None  # the mailbox: written by one thread, read by all
        self.counts = FrameTotals()  # immutable: other threads read it
        self._next_index = 0
        self._counted_s: float | None = None  # arrival of the last counted frame
        self._gap: Gap | None = None  # before that frame
        self._lost = 0  # before that frame
        self.gap_cause = ""  # last work that delayed the worker's frames
        self._clock_lag_s = math.inf  # this computer's clock minus the camera's
        self._updated_s = -math.inf

    def acquire(self, instrument: Instrument, light: LightState | None) -> None:
        """Read one frame, reconstruct it and pass it on; `Cancelled` if the wait was stopped."""
        self.process(self._newest_frame(instrument, light), instrument, light)

    def process_single(self, frame: Frame, instrument: Instrument, light: LightState | None, file: str) -> None:
        """Reconstruct a frame from a `file` or elsewhere, as if exposed when it was read, and pass it on."""
        self._gap, self._lost = None, 0
        self.counts = replace(self.counts, acquired=self.counts.acquired + 1)
        exposed = replace(frame, camera_time_s=frame.host_time_s - self._lag_s)
        self.process(exposed, instrument, light, file, is_live=False)

    def process(
        self, frame: Frame, instrument: Instrument, light: LightState | None, file: str = "", *, is_live: bool = True
    ) -> None:
        """Reconstruct a frame and pass it on."""
        begin_s = time.perf_counter()
        made = instrument.measure(frame) if is_live else instrument.measure_single(frame, is_foreign=bool(file))
        self.measured_in_s = time.perf_counter() - begin_s
        if made.wavefront is not None:
            self.counts = replace(self.counts, reconstructed=self.counts.reconstructed + 1)
        measurement = self._completed(made, light, file)
        self._timings.note("to_result", measurement.latency_s)
        with self._timings.of("publish"):
            self._publish(measurement)
            self.newest = measurement

    def show(self, frame: Frame, text: str, light: LightState | None) -> None:
        """Put a frame into the mailbox with a text in place of a wavefront, neither measured nor counted."""
        self._update_clock(frame)
        self.newest = shown = self._completed(Measurement(frame, None, text), light)
        self._on_show(shown)

    def _newest_frame(self, instrument: Instrument, light: LightState | None) -> Frame:
        """Wait for a frame; if it is old already, skip to the newest in the camera."""
        camera, start_s = instrument.devices.camera, time.perf_counter()
        frame = next_frame(camera, lambda: self._must_stop_waiting(instrument))
        arrived_s = max(frame.host_time_s, start_s)  # it may have been waiting in the camera
        self._timings.note("wait", arrived_s - start_s)
        self._timings.note("copy", time.perf_counter() - arrived_s)
        self._count(frame)
        if time.perf_counter() - self._exposure_end_s(frame) > max(_OLD_S, 2 * frame.exposure_s):
            while not self._must_stop_waiting(instrument) and time.perf_counter() < arrived_s + _SKIPPING_S:
                try:
                    newer = camera.read(0.0)
                except (DeviceTimeout, FrameLost):  # only of the camera: a light may time out in `_must_stop_waiting`
                    break
                self._publish(self._completed(instrument.skip(frame), light))
                frame = newer
                self._count(frame)
        return frame

    def _publish(self, measurement: Measurement) -> None:
        for sink in self.sinks:
            sink(measurement)

    def _completed(self, made: Measurement, light: LightState | None, file: str = "") -> Measurement:
        exposure_end_s = self._exposure_end_s(made.frame)
        return replace(
            made,
            lost=self._lost,
            light=light,
            gap=self._gap,
            counts=self.counts,
            exposure_end_s=exposure_end_s,
            latency_s=time.perf_counter() - exposure_end_s,
            file=file,
        )

    def _count(self, frame: Frame) -> None:
        """Count a frame and those lost before it; note a gap if the camera was restarted."""
        was_restarted = frame.index < self._next_index
        self._lost = frame.index if was_restarted else frame.index - self._next_index
        self._next_index = frame.index + 1
        self.counts = replace(self.counts, acquired=self.counts.acquired + 1, lost=self.counts.lost + self._lost)
        self._gap = None
        if was_restarted and self._counted_s is not None:
            seconds = max(frame.host_time_s - self._counted_s - frame.exposure_s, 0.0)
            self._gap = Gap(seconds, self.gap_cause or "the camera was stopped")
        self.gap_cause = ""
        self._counted_s = frame.host_time_s
        self._update_clock(frame)

    def _update_clock(self, frame: Frame) -> None:
        """Update the clock difference by the smallest delay seen, until clocks drift."""
        elapsed_s = max(frame.host_time_s - self._updated_s, 0.0)
        self._updated_s = frame.host_time_s
        allowed_s = self._clock_lag_s + _CLOCK_DRIFT * elapsed_s
        self._clock_lag_s = min(allowed_s, frame.host_time_s - frame.camera_time_s)

    @property
    def _lag_s(self) -> float:
        """The clock difference; 0 before the first frame of the camera."""
        return self._clock_lag_s if math.isfinite(self._clock_lag_s) else 0.0

    def _exposure_end_s(self, frame: Frame) -> float:
        return frame.camera_time_s + self._lag_s


def read_frame(path: Path, camera: Camera) -> Frame:
    """Read an image file as a frame with the exposure and gain of a camera.

    `InputError` if it is no image of counts from 0 to 65535, or of another size than the camera's frames.
    """
    image, allowed = read_image(path), camera.capabilities
    if image.shape != (allowed.rows, allowed.columns):
        sizes = f"{image.shape[0]} x {image.shape[1]} pixels, the camera's frames {allowed.rows} x {allowed.columns}"
        raise InputError(f"{path}: has {sizes}")
    if not (np.isfinite(image).all() and image.min() >= 0 and image.max() <= np.iinfo(np.uint16).max):
        raise InputError(f"{path}: holds values that are no counts from 0 to 65535")
    now_s = time.perf_counter()
    return Frame(
        pixels=np.rint(image).astype(np.uint16),
        index=0,
        camera_time_s=now_s,
        host_time_s=now_s,
        exposure_s=camera.exposure_s,
        em_gain=camera.em_gain,
    )

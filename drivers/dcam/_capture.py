"""Capture of frames through the DCAM-API's ring buffer."""

import math
from collections.abc import Callable
from contextlib import suppress
from ctypes import Structure, byref, c_int32

import numpy as np

from drivers.camera import CLOSING, INTERNAL, NO_FRAME, STOPPED, Frame, SettingsInForce
from drivers.dcam._library import BufferFrame, TransferInfo, WaitOpen, WaitStart, sized
from drivers.dcam._properties import PRODUCER_NONE, Id, Properties
from drivers.errors import DeviceError, DeviceTimeout, FrameLost, WrongState

_SLICE_S = 0.1  # longest wait in the library; after that much silence the camera's status is polled
_SEQUENCE = -1
_FRAMEREADY, _STOPPED = 0x2, 0x10
_BUSY = 1
_STAMPS = 2**16  # some interfaces carry only 16 bits of the camera's frame number


class Capture:
    """One capture. A frame's index is the library's count plus those lost before transfer, by the camera's count."""

    def __init__(
        self,
        properties: Properties,
        *,
        shape: tuple[int, int],
        in_force: tuple[float, float],
        clock: Callable[[], float],
        trigger: str,
    ) -> None:
        self._library = properties.library
        self._handle = properties.handle
        self._properties = properties
        self._shape = shape
        self._clock = clock
        self._is_exposing = trigger == INTERNAL  # as far as known
        self._in_force = SettingsInForce(*in_force)
        self._next = 0  # library's number of the next frame
        self._lost = 0  # before transfer
        self._last: tuple[int, int] | None = None  # library's and camera's number of the last frame
        self._is_loss_reported = False
        self._is_aborted = False
        self._has_stamps = self._properties.get_or(Id.FRAMESTAMP_PRODUCER, PRODUCER_NONE) != PRODUCER_NONE
        self._seen_alive_s = clock()
        self._wait_handle = 0
        self._to_undo: list[Callable[[], None]] = []

    def begin(self, ring_frames: int) -> None:
        """Start the capture into a ring of so many frames; after a failure call `end`."""
        self._ring_frames, call = ring_frames, self._library.call
        opened = sized(WaitOpen, hdcam=self._handle)
        call("dcamwait_open", byref(opened))
        self._wait_handle = opened.hwait
        self._to_undo.append(lambda: call("dcamwait_close", self._wait_handle))
        call("dcambuf_alloc", self._handle, self._ring_frames)
        self._to_undo.append(lambda: call("dcambuf_release", self._handle, 0))
        call("dcamcap_start", self._handle, _SEQUENCE)

    def stop(self) -> None:
        """Stop taking frames; `end` is still needed."""
        with suppress(WrongState):  # it had stopped on its own
            self._library.call("dcamcap_stop", self._handle)

    def end(self) -> None:
        """Release the ring; after a failure it can be called again."""
        while self._to_undo:
            self._to_undo[-1]()
            self._to_undo.pop()

    def abort(self) -> None:
        """Make `read` in another thread raise `WrongState` at once; only `end` may follow."""
        self._is_aborted = True
        with suppress(DeviceError):  # then `read` finishes its slice
            self._library.call("dcamwait_abort", self._wait_handle)

    def change(self, exposure_s: float, em_gain: float) -> None:
        """Record changed settings; they hold from the frame after the one being exposed, if any."""
        first = self._transferred().nFrameCount + self._lost + self._is_exposing
        self._in_force.change(first, exposure_s, em_gain)

    def read(self, timeout_s: float) -> Frame:
        """Return the oldest unread frame; `WrongState` if the capture has stopped or was aborted: `end` must follow."""
        deadline_s = self._clock() + timeout_s
        while not self._is_aborted:
            frame = self._oldest()
            if frame is not None:
                return frame
            remaining_s = deadline_s - self._clock()
            if remaining_s <= 0:
                self._check_alive()
                raise DeviceTimeout(NO_FRAME)
            self._wait(min(remaining_s, _SLICE_S))
        raise WrongState(CLOSING)

    def _wait(self, duration_s: float) -> None:
        """Wait for the next event."""
        request = sized(WaitStart, eventmask=_FRAMEREADY | _STOPPED, timeout=math.ceil(1e3 * duration_s))
        try:
            self._library.call("dcamwait_start", self._wait_handle, byref(request))
        except DeviceTimeout:
            self._check_alive()
        except FrameLost:
            self._is_loss_reported = True
        else:
            if request.eventhappened & _STOPPED:
                self._check_alive(at_once=True)

    def _check_alive(self, *, at_once: bool = False) -> None:
        """Raise if a camera, silent for a slice, is gone or has stopped."""
        now_s = self._clock()
        if at_once:
            self._seen_alive_s = -math.inf
        if now_s - self._seen_alive_s < 0.9 * _SLICE_S:
            return
        self._properties.check_online()
        status = c_int32()
        self._library.call("dcamcap_status", self._handle, byref(status))
        if status.value != _BUSY:
            raise WrongState(STOPPED)
        self._seen_alive_s = now_s

    def _oldest(self) -> Frame | None:
        """The oldest intact frame in the ring, if any; overwritten ones are skipped."""
        transferred = self._transferred()
        waiting = transferred.nFrameCount - self._next
        if waiting <= 0:
            return None
        if waiting >= self._ring_frames:  # skip half of the ring, so that the next frames are not overwritten, too
            self._next = transferred.nFrameCount - self._ring_frames // 2
        number = self._next
        self._next += 1  # also if its copy fails
        slot = (transferred.nNewestFrameIndex - (transferred.nFrameCount - 1 - number)) % self._ring_frames
        rows, columns = self._shape
        pixels = np.empty(self._shape, np.uint16)
        copied = sized(
            BufferFrame, iFrame=slot, buf=pixels.ctypes.data, rowbytes=pixels.strides[0], width=columns, height=rows
        )
        self._library.call("dcambuf_copyframe", self._handle, byref(copied))
        pixels.setflags(write=False)
        host_time_s = self._clock()
        if self._transferred().nFrameCount - number >= self._ring_frames:  # overwritten during the copy
            return None
        self._seen_alive_s = host_time_s
        self._count_lost(number, copied.framestamp)
        index = number + self._lost
        camera_time_s = copied.timestamp.sec + 1e-6 * copied.timestamp.microsec  # 0 without time stamps
        exposure_s, em_gain = self._in_force.of_frame(index)
        return Frame(
            pixels=pixels,
            index=index,
            camera_time_s=camera_time_s or host_time_s,
            host_time_s=host_time_s,
            exposure_s=exposure_s,
            em_gain=em_gain,
        )

    def _count_lost(self, number: int, stamp: int) -> None:
        """Count the frames that the camera took but the library never received."""
        if self._has_stamps and self._last is not None:
            last_number, last_stamp = self._last
            missing = (stamp - last_stamp - (number - last_number)) % _STAMPS
            if missing < _STAMPS // 2:  # else the camera restarted its numbers
                self._lost += missing
        elif not self._has_stamps and self._is_loss_reported:  # at least one
            self._lost += 1
        self._is_loss_reported = False
        self._last = number, stamp

    def _transferred(self) -> Structure:
        answer = sized(TransferInfo)
        self._library.call("dcamcap_transferinfo", self._handle, byref(answer))
        return answer

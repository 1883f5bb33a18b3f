"""Frames on their way out of the DCAM-API's ring, from the start of a capture to its end."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from ctypes import byref, c_int32
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.dcam.properties import Properties
from drivers.dcam.property_ids import ALIVE_ONLINE, PRODUCER_NONE, Id
from drivers.dcam.structures import BufferFrame, TransferInfo, WaitOpen, WaitStart, sized
from drivers.errors import DeviceError, DeviceTimeout, Disconnected, FrameLost, WrongState
from drivers.frame import Frame

_SLICE_S = (
    0.1  # the longest wait in the library, and how long silence lasts before the camera is asked whether it lives
)
_SEQUENCE = -1
_FRAMEREADY, _STOPPED = 0x2, 0x10
_BUSY = 1
_STAMPS = 2**16  # some interfaces carry no more bits of the camera's own count


@dataclass(frozen=True, slots=True)
class InForce:
    """Exposure and gain of all frames from this index on."""

    first_index: int
    exposure_s: float
    em_gain: float


class Capture:
    """A capture: begun, read from, stopped, ended.

    The number of a frame is the library's count of transferred frames, and those lost before their transfer, which
    the camera's own count of its frames tells. With the software trigger, whoever waits for a frame lets it begin.
    """

    def __init__(
        self,
        values: Properties,
        shape: tuple[int, int],
        ring_frames: int,
        in_force: tuple[float, float],
        clock: Callable[[], float],
        *,
        trigger: str,
    ) -> None:
        self._library = values.library
        self._handle = values.handle
        self._values = values
        self._shape = shape
        self._ring_frames = ring_frames
        self._clock = clock
        self._is_fired_here = trigger == "software"
        self._is_exposing = trigger == "internal"  # a frame is under way, as far as is known
        self._in_force = deque([InForce(0, *in_force)])
        self._next = 0  # in the library's count
        self._lost = 0  # before their transfer
        self._last: tuple[int, int] | None = None  # the library's and the camera's count of the last frame
        self._is_loss_told = False
        self._is_aborted = False
        self._has_stamps = self._values.get_or(Id.FRAMESTAMP_PRODUCER, PRODUCER_NONE) != PRODUCER_NONE
        self._seen_alive_s = clock()
        self._wait_handle = 0
        self._to_undo: list[Callable[[], None]] = []

    def begin(self) -> None:
        """Have frames taken; when a step fails, it is to be ended."""
        call = self._library.call
        opened = sized(WaitOpen, hdcam=self._handle)
        call("dcamwait_open", byref(opened))
        self._wait_handle = opened.hwait
        self._to_undo.append(lambda: call("dcamwait_close", self._wait_handle))
        call("dcambuf_alloc", self._handle, self._ring_frames)
        self._to_undo.append(lambda: call("dcambuf_release", self._handle, 0))
        call("dcamcap_start", self._handle, _SEQUENCE)

    def stop(self) -> None:
        """Take no more frames; what is left is to be ended."""
        with suppress(WrongState):  # it has stopped by itself
            self._library.call("dcamcap_stop", self._handle)

    def end(self) -> None:
        """Give the ring back; when a step fails, it can be tried again from there."""
        while self._to_undo:
            self._to_undo[-1]()
            self._to_undo.pop()

    def abort(self) -> None:
        """Let `read` in another thread come back at once with `WrongState`; the capture can only be ended then."""
        self._is_aborted = True
        with suppress(DeviceError):  # then it waits for the rest of its slice
            self._library.call("dcamwait_abort", self._wait_handle)

    def change(self, exposure_s: float, em_gain: float) -> None:
        """Note settings that were changed just now: they hold from the frame after the one that is being exposed.

        The DCAM-API does not tell what each frame was taken with. Where a trigger is awaited, none is being exposed.
        """
        first = self._transferred().nFrameCount + self._lost + self._is_exposing
        if self._in_force[-1].first_index == first:
            self._in_force.pop()
        self._in_force.append(InForce(first, exposure_s, em_gain))

    def read(self, timeout_s: float) -> Frame:
        """Return the oldest frame not yet read, or wait for it; the software trigger is fired for it, once.

        Raises `WrongState` when the capture has ended by itself or was aborted: it is to be ended then.
        """
        deadline_s = self._clock() + timeout_s
        while not self._is_aborted:
            frame = self._oldest()
            if frame is not None:
                return frame
            if self._is_fired_here and not self._is_exposing:
                self._fire()
            remaining_s = deadline_s - self._clock()
            if remaining_s <= 0:
                self._check_alive()
                raise DeviceTimeout(f"no frame came within {timeout_s:g} s")
            self._wait(min(remaining_s, _SLICE_S))
        raise WrongState("the camera is being closed")

    def _fire(self) -> None:
        """Let an exposure begin; a camera that cannot take the trigger yet is asked again."""
        try:
            self._library.call("dcamcap_firetrigger", self._handle, 0)
        except WrongState:
            self._ask_at_once()
        else:
            self._is_exposing = True

    def _ask_at_once(self) -> None:
        """Ask the camera whether it lives, however short its silence was."""
        self._seen_alive_s = -math.inf
        self._check_alive()

    def _wait(self, duration_s: float) -> None:
        """Wait for the next event, at most so long."""
        asked = sized(WaitStart, eventmask=_FRAMEREADY | _STOPPED, timeout=math.ceil(1e3 * duration_s))
        try:
            self._library.call("dcamwait_start", self._wait_handle, byref(asked))
        except DeviceTimeout:
            self._check_alive()
        except FrameLost:
            self._is_loss_told = True
            self._note_end()
        else:
            if asked.eventhappened & _STOPPED:
                self._ask_at_once()

    def _note_end(self) -> None:
        """Note that the exposure is over that was begun here."""
        if self._is_fired_here:
            self._is_exposing = False

    def _check_alive(self) -> None:
        """Ask a camera that has been silent whether it is there and capturing."""
        now_s = self._clock()
        if now_s - self._seen_alive_s < 0.9 * _SLICE_S:
            return
        if self._values.get_or(Id.SYSTEM_ALIVE, ALIVE_ONLINE) != ALIVE_ONLINE:
            raise Disconnected("the camera is gone: check its power and cable, then connect again")
        status = c_int32()
        self._library.call("dcamcap_status", self._handle, byref(status))
        if status.value != _BUSY:
            raise WrongState("the camera has stopped taking frames by itself; start it again")
        self._seen_alive_s = now_s

    def _oldest(self) -> Frame | None:
        """The oldest frame that is whole in the ring, if any; what was overwritten is skipped, and shows as a gap."""
        told = self._transferred()
        waiting = told.nFrameCount - self._next
        if waiting <= 0:
            return None
        if waiting >= self._ring_frames:  # half of the ring is given up, so that the next are not overwritten, too
            self._next = told.nFrameCount - self._ring_frames // 2
        number = self._next
        self._next += 1  # also when its copying fails
        self._note_end()
        slot = (told.nNewestFrameIndex - (told.nFrameCount - 1 - number)) % self._ring_frames
        pixels, copied = self._copy(slot)
        host_time_s = self._clock()
        if self._transferred().nFrameCount - number >= self._ring_frames:  # overwritten meanwhile
            return None
        return self._frame(number, pixels, copied, host_time_s)

    def _copy(self, slot: int) -> tuple[NDArray[np.uint16], BufferFrame]:
        """Copy a frame out of the ring into an array of its own."""
        rows, columns = self._shape
        pixels = np.empty(self._shape, np.uint16)
        copied = sized(
            BufferFrame,
            iFrame=slot,
            buf=pixels.ctypes.data,
            rowbytes=pixels.strides[0],
            width=columns,
            height=rows,
        )
        self._library.call("dcambuf_copyframe", self._handle, byref(copied))
        pixels.setflags(write=False)
        return pixels, copied

    def _frame(self, number: int, pixels: NDArray[np.uint16], copied: BufferFrame, host_time_s: float) -> Frame:
        self._seen_alive_s = host_time_s
        self._count_lost(number, copied.framestamp)
        index = number + self._lost
        while len(self._in_force) > 1 and self._in_force[1].first_index <= index:
            self._in_force.popleft()
        in_force = self._in_force[0]
        camera_time_s = copied.timestamp.sec + 1e-6 * copied.timestamp.microsec
        return Frame(
            pixels,
            index,
            camera_time_s or host_time_s,  # 0 where nobody stamps the frames
            host_time_s,
            in_force.exposure_s,
            in_force.em_gain,
        )

    def _count_lost(self, number: int, stamp: int) -> None:
        """Count the frames that the camera has taken but the library has never seen."""
        if self._has_stamps and self._last is not None:
            last_number, last_stamp = self._last
            missing = (stamp - last_stamp - (number - last_number)) % _STAMPS
            if missing < _STAMPS // 2:  # else the stamps began anew
                self._lost += missing
        elif not self._has_stamps and self._is_loss_told:  # at least one
            self._lost += 1
        self._is_loss_told = False
        self._last = number, stamp

    def _transferred(self) -> TransferInfo:
        told = sized(TransferInfo)
        self._library.call("dcamcap_transferinfo", self._handle, byref(told))
        return told

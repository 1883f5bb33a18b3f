"""The line to one GenICam camera: its features, its stream of buffers, and whether it is still there."""

from __future__ import annotations

import ctypes
import time
from concurrent.futures import Future, wait
from typing import Any, Final

from drivers.errors import Busy, DeviceError, Disconnected
from drivers.genicam.calls import PatientCalls, comes_now
from drivers.genicam.library import PACKET_SOCKET_DISABLED, SOCKET_BUFFER_FIXED, Aravis
from drivers.genicam.settings import GenicamSettings

PATIENCE_S: Final = 1.1  # three of Aravis's attempts to reach a GigE camera: one lost packet is no disconnection
_OPENING_S: Final = 10.0  # the camera's description of itself is loaded, some 100 kB in pieces of 500 bytes
_SIGN_INTERVAL_S: Final = 0.3
_LETTING_GO_S: Final = 0.5
_SAFE_PACKET_BYTES: Final = 1400  # passes through every network


class GenicamConnection:
    """A camera under our control, until it is closed; every call raises `Disconnected` when it does not answer."""

    def __init__(self, aravis: Aravis, device: str, settings: GenicamSettings) -> None:
        self._aravis = aravis
        self._settings = settings
        self._calls = PatientCalls(f"genicam {device}")
        self._camera = 0  # this and the next are made and let go of in the thread of the calls alone
        self._stream = 0
        self.is_gige = False
        self.is_streaming = False
        self._sign_of_life: Future[int] | None = None
        self._asked_s = 0.0
        try:
            self._calls.make(lambda: self._open(device), _OPENING_S)
            self._handle = aravis.call("arv_camera_get_device", self._camera)
            self.is_gige = bool(aravis.call("arv_camera_is_gv_device", self._camera))
            if self.is_gige:
                self._prepare_network(device)
        except BaseException:
            self.close()
            raise

    def call(self, name: str, *arguments: Any, patience_s: float = PATIENCE_S) -> Any:
        """Call the library's function of that name with the camera as its first argument."""
        self._check_control()
        return self._calls.make(lambda: self._aravis.call(name, self._camera, *arguments), patience_s)

    def has(self, feature: str) -> bool:
        """Whether the camera has this feature, now."""
        return bool(self.call("arv_camera_is_feature_available", feature.encode()))

    def choices(self, feature: str) -> tuple[str, ...]:
        """Return the values that an enumeration can have now; none where there is no such feature."""
        if not self.has(feature):
            return ()
        return self._calls.make(lambda: self._aravis.choices(self._camera, feature), PATIENCE_S)

    def text(self, feature: str) -> str:
        """Return the value of a feature in words."""
        return self.call("arv_camera_get_string", feature.encode()) or ""

    def set_text(self, feature: str, value: str) -> None:
        """Change a feature that has values in words."""
        self.call("arv_camera_set_string", feature.encode(), value.encode())

    def integer(self, feature: str) -> int:
        """Return the value of a whole-numbered feature."""
        return int(self.call("arv_camera_get_integer", feature.encode()))

    def number(self, feature: str) -> float:
        """Return the value of a feature that is a number with a fraction."""
        return float(self.call("arv_camera_get_float", feature.encode()))

    def integer_bounds(self, feature: str) -> tuple[int, int, int]:
        """Return the least and the greatest value of a whole-numbered feature, and the step between its values."""
        low, high = ctypes.c_int64(), ctypes.c_int64()
        name = feature.encode()
        self.call("arv_camera_get_integer_bounds", name, ctypes.byref(low), ctypes.byref(high))
        return low.value, high.value, max(1, self.call("arv_camera_get_integer_increment", name))

    def bounds(self, function: str) -> tuple[float, float]:
        """Return the two numbers that a function of the library gives by its arguments."""
        low, high = ctypes.c_double(), ctypes.c_double()
        self.call(function, ctypes.byref(low), ctypes.byref(high))
        return low.value, high.value

    def region(self) -> tuple[int, int, int, int]:
        """Return left, top, columns and rows of what is read out, in binned pixels."""
        numbers = [ctypes.c_int() for _ in range(4)]
        self.call("arv_camera_get_region", *map(ctypes.byref, numbers))
        left, top, columns, rows = (number.value for number in numbers)
        return left, top, columns, rows

    def start_stream(self, payload_bytes: int) -> None:
        """Make ready for frames of this size and let them come."""
        self._calls.make(self._create_stream, PATIENCE_S)
        if self.is_gige:
            self._aravis.set_property(self._stream, "socket-buffer", SOCKET_BUFFER_FIXED)
            self._aravis.set_property(self._stream, "socket-buffer-size", self._settings.socket_buffer_bytes)
        for _ in range(self._settings.buffers):
            self.give_back(self._aravis.call("arv_buffer_new_allocate", payload_bytes))
        try:
            self.call("arv_camera_execute_command", b"AcquisitionStart")
        except DeviceError:
            self._calls.submit(self._release_stream)
            raise
        self.is_streaming = True

    def stop_stream(self, exposure_s: float) -> None:
        """Let no more frames come; a camera may finish the exposure before it answers."""
        self.call("arv_camera_get_integer", b"Width")  # so that one that is gone is not waited for that long
        self.call("arv_camera_execute_command", b"AcquisitionStop", patience_s=PATIENCE_S + exposure_s)
        self.is_streaming = False
        self._calls.make(self._release_stream, PATIENCE_S)

    def next_buffer(self, timeout_s: float) -> int:
        """Return the oldest buffer that was filled, or 0 if none came; it must be given back."""
        microseconds = round(timeout_s * 1e6)
        return self._aravis.call("arv_stream_timeout_pop_buffer", self._stream, microseconds) or 0

    def give_back(self, buffer: int) -> None:
        """Let the buffer be filled again."""
        self._aravis.call("arv_stream_push_buffer", self._stream, buffer)

    def watch(self) -> None:
        """Ask the camera for a sign of life, without waiting for it; raise `Disconnected` when one is overdue.

        To be called again and again while no frames come.
        """
        self._check_control()
        now_s = time.perf_counter()
        if self._sign_of_life is None:
            if now_s - self._asked_s > _SIGN_INTERVAL_S:
                self._asked_s = now_s
                self._sign_of_life = self._calls.submit(
                    lambda: self._aravis.call("arv_camera_get_integer", self._camera, b"Width")
                )
        elif self._sign_of_life.done():
            self._sign_of_life.result()  # raises what the library said
            self._sign_of_life = None
        elif now_s - self._asked_s > PATIENCE_S and not comes_now(self._sign_of_life):
            raise Disconnected(f"no frames, and no answer for {PATIENCE_S} s: is the camera connected and on?")

    def close(self) -> None:
        """Let go of the camera; one that is gone is hardly waited for."""
        self.is_streaming = False
        wait((self._calls.submit(self._release),), _LETTING_GO_S)
        self._calls.end()

    def _open(self, device: str) -> None:
        self._camera = self._aravis.call("arv_camera_new", device.encode())

    def _create_stream(self) -> None:
        self._stream = self._aravis.call("arv_camera_create_stream", self._camera, None, None)

    def _release_stream(self) -> None:
        if stream := self._stream:
            self._stream = 0
            self._aravis.call("g_object_unref", stream)

    def _release(self) -> None:
        self._release_stream()
        if self._camera:
            self._aravis.call("g_object_unref", self._camera)

    def _prepare_network(self, device: str) -> None:
        """Make sure that the camera obeys us, and choose how frames come through the network."""
        if not self._aravis.call("arv_gv_device_is_controller", self._handle):
            raise Busy(
                f"another program has the camera {device}: close that program first"
                " (one that was killed holds it for three more seconds)"
            )
        if not self._settings.packet_socket:
            self._aravis.call("arv_camera_gv_set_stream_options", self._camera, PACKET_SOCKET_DISABLED)
        self.call("arv_camera_gv_set_packet_size", self._settings.packet_size or _SAFE_PACKET_BYTES)
        if self._settings.packet_size is None:  # tries larger ones, with cameras that send packets for a test
            self.call("arv_camera_gv_auto_packet_size", patience_s=_OPENING_S)

    def _check_control(self) -> None:
        """Raise `Disconnected` if the camera was taken away, or began anew, without our hearing of it otherwise."""
        if self.is_gige and not self._aravis.call("arv_gv_device_is_controller", self._handle):
            raise Disconnected("the camera no longer obeys this program: it was switched off, or another one has it")

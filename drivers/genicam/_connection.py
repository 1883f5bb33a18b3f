"""Connection to one GenICam camera: features, stream of buffers, sign of life."""

import ctypes
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import suppress
from ipaddress import ip_address
from queue import SimpleQueue
from typing import Any, Final, TypeVar

from drivers.device import choose
from drivers.errors import Busy, DeviceError, Disconnected, Unsupported, attempt
from drivers.genicam import GenicamSettings
from drivers.genicam._library import PACKET_SOCKET_DISABLED, READ_WRITE, SOCKET_BUFFER_FIXED, Aravis, load_aravis

TIMEOUT_S: Final = 1.1  # three attempts of Aravis: one lost packet is no disconnection
_DISCOVERY_S: Final = 2.0  # cameras in the network have one second to answer
_OPENING_S: Final = 10.0  # loads the camera's XML description, some 100 kB in packets of 500 bytes
_SIGN_INTERVAL_S: Final = 0.3
_RELEASE_S: Final = 0.5
_GRACE_S = 0.2
_SAFE_PACKET_BYTES: Final = 1400  # passes through every network
T = TypeVar("T")


class CallThread:
    """A daemon thread that makes calls in order, so that callers can give up waiting.

    Aravis tries for 2.5 s to reach a missing camera, at every register access.
    """

    def __init__(self, name: str) -> None:
        self._waiting: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def submit(self, call: Callable[[], T]) -> Future[T]:
        """Queue a call."""
        future: Future[T] = Future()
        self._waiting.put((future, call))
        return future

    def call_within(self, call: Callable[[], T], timeout_s: float) -> T:
        """Make a call and return its result; raise `Disconnected` if that takes too long."""
        future = self.submit(call)
        if wait((future,), timeout_s).not_done and not _comes_now(future):
            raise Disconnected(f"the camera did not answer for {timeout_s:.1f} s: is it connected and on?")
        return future.result()

    def end(self) -> None:
        """End the thread after the queued calls."""
        self._waiting.put(None)

    def _run(self) -> None:
        while (item := self._waiting.get()) is not None:
            future, call = item
            try:
                future.set_result(call())
            except BaseException as error:  # noqa: BLE001 - passed to the future
                future.set_exception(error)


def _comes_now(future: Future[Any]) -> bool:
    """True if an overdue answer arrives after all, because this computer stalled and not the camera."""
    return bool(wait((future,), _GRACE_S).done)


class GenicamConnection:
    """A controlled camera; every call raises `Disconnected` if it does not answer."""

    def __init__(self, aravis: Aravis, device: str, settings: GenicamSettings) -> None:
        self._aravis = aravis
        self._settings = settings
        self._calls = CallThread(f"genicam {device}")
        self._camera = 0  # created and released in the call thread only, as is the stream
        self._stream = 0
        self.is_gige = False
        self.is_streaming = False
        self._sign_of_life: Future[int] | None = None
        self._asked_s = 0.0
        try:
            self._calls.call_within(lambda: self._open(device), _OPENING_S)
            self._handle = aravis.call("arv_camera_get_device", self._camera)
            self.is_gige = bool(aravis.call("arv_camera_is_gv_device", self._camera))
            if self.is_gige:
                self._prepare_network(device)
        except BaseException:
            self.close()
            raise

    def call(self, name: str, *arguments: Any, timeout_s: float = TIMEOUT_S) -> Any:
        """Call an Aravis function with the camera as first argument."""
        self._check_control()
        return self._calls.call_within(lambda: self._aravis.call(name, self._camera, *arguments), timeout_s)

    def has(self, feature: str) -> bool:
        """True if the feature is implemented and available now."""
        return bool(
            attempt(self.call, "arv_camera_is_feature_available", feature.encode())
            and attempt(self._call_node, "arv_gc_feature_node_is_implemented", feature)
        )

    def is_writable(self, feature: str) -> bool:
        """True if the feature is available and not locked now."""
        if not self.has(feature):
            return False
        is_locked = attempt(self._call_node, "arv_gc_feature_node_is_locked", feature)
        return is_locked == 0 and self._call_node("arv_gc_feature_node_get_actual_access_mode", feature) == READ_WRITE

    def choices(self, feature: str) -> tuple[str, ...]:
        """Return the present values of an enumeration; () if the camera lacks it."""
        if not self.has(feature):
            return ()
        self._check_control()
        return self._calls.call_within(lambda: self._aravis.choices(self._camera, feature), TIMEOUT_S)

    def text(self, feature: str) -> str:
        """Return the value of a feature of any type as text."""
        return self._call_node("arv_gc_feature_node_get_value_as_string", feature) or ""

    def set_text(self, feature: str, value: str) -> None:
        """Change a feature of any type to a value given as text."""
        self._call_node("arv_gc_feature_node_set_value_from_string", feature, value.encode())

    def optional_text(self, feature: str) -> str | None:
        """Return the value of a feature as text; None if it is missing or cannot be read."""
        return attempt(self.text, feature) if self.has(feature) else None

    def integer(self, feature: str) -> int:
        """Return the value of an integer feature."""
        return int(self.call("arv_camera_get_integer", feature.encode()))

    def number(self, feature: str) -> float:
        """Return the value of an integer or float feature."""
        text = self.text(feature)
        try:
            return float(text)
        except ValueError as error:
            raise Unsupported(f"the camera's feature {feature} is no number but {text!r}") from error

    def integer_bounds(self, feature: str) -> tuple[int, int, int]:
        """Return minimum, maximum and step of an integer feature."""
        name = feature.encode()
        low, high = self.outputs("arv_camera_get_integer_bounds", name, kind=ctypes.c_int64)
        return low, high, max(1, self.call("arv_camera_get_integer_increment", name))

    def region(self) -> list[int]:
        """Return left, top, columns and rows of the region, in binned pixels."""
        return self.outputs("arv_camera_get_region", kind=ctypes.c_int, count=4)

    def outputs(self, name: str, *arguments: Any, kind: Any = ctypes.c_double, count: int = 2) -> list[Any]:
        """Call an Aravis function with the camera as first argument; return its output arguments."""
        outputs = [kind() for _ in range(count)]
        self.call(name, *arguments, *map(ctypes.byref, outputs))
        return [output.value for output in outputs]

    def start_stream(self, payload_bytes: int) -> None:
        """Allocate buffers of this size and start the acquisition."""
        self._calls.call_within(self._create_stream, TIMEOUT_S)
        if self.is_gige:
            self._aravis.set_property(self._stream, "socket-buffer", SOCKET_BUFFER_FIXED)
            self._aravis.set_property(self._stream, "socket-buffer-size", self._settings.socket_buffer_bytes)
        for _ in range(self._settings.buffers):
            self.give_back(self._aravis.call("arv_buffer_new_allocate", payload_bytes))
        try:
            self.call("arv_camera_start_acquisition")
        except DeviceError:
            self._calls.submit(self._release_stream)
            raise
        self.is_streaming = True

    def stop_stream(self, exposure_s: float) -> None:
        """Stop the acquisition; the camera may finish the exposure before it answers."""
        self.call("arv_camera_get_integer", b"Width")  # notices a missing camera sooner
        self.call("arv_camera_stop_acquisition", timeout_s=TIMEOUT_S + exposure_s)
        self.is_streaming = False
        self._calls.call_within(self._release_stream, TIMEOUT_S)

    def next_buffer(self, timeout_s: float) -> int:
        """Return the oldest filled buffer, or 0 after the timeout; it must be given back."""
        microseconds = round(timeout_s * 1e6)
        return self._aravis.call("arv_stream_timeout_pop_buffer", self._stream, microseconds) or 0

    def give_back(self, buffer: int) -> None:
        """Return a buffer for refilling."""
        self._aravis.call("arv_stream_push_buffer", self._stream, buffer)

    def watch(self) -> None:
        """Poll a silent camera without waiting; raise `Disconnected` if an answer is overdue."""
        self._check_control()
        now_s = time.perf_counter()
        if self._sign_of_life is None:
            if now_s - self._asked_s > _SIGN_INTERVAL_S:
                self._asked_s = now_s
                self._sign_of_life = self._calls.submit(
                    lambda: self._aravis.call("arv_camera_get_integer", self._camera, b"Width")
                )
        elif self._sign_of_life.done():
            self._sign_of_life.result()  # raises the library's error
            self._sign_of_life = None
        elif now_s - self._asked_s > TIMEOUT_S and not _comes_now(self._sign_of_life):
            raise Disconnected(f"no frames, and no answer for {TIMEOUT_S} s: is the camera connected and on?")

    def close(self) -> None:
        """Release the camera, with a short wait for a missing one."""
        self.is_streaming = False
        wait((self._calls.submit(self._release),), _RELEASE_S)
        self._calls.end()

    def _call_node(self, name: str, feature: str, *arguments: Any) -> Any:
        """Call an Aravis function with a feature as first argument."""
        if not (node := self._aravis.call("arv_device_get_feature", self._handle, feature.encode())):
            raise Unsupported(f"the camera has no feature {feature}")
        self._check_control()
        return self._calls.call_within(lambda: self._aravis.call(name, node, *arguments), TIMEOUT_S)

    def _open(self, device: str) -> None:
        self._camera = self._aravis.call("arv_camera_new", device.encode())

    def _create_stream(self) -> None:
        self._stream = self._aravis.create_stream(self._camera)

    def _release_stream(self) -> None:
        if stream := self._stream:
            self._stream = 0
            self._aravis.call("g_object_unref", stream)

    def _release(self) -> None:
        self._release_stream()
        if self._camera:
            self._aravis.call("g_object_unref", self._camera)

    def _prepare_network(self, device: str) -> None:
        """Check that this program controls the camera, and choose the transport of frames."""
        if not self._aravis.call("arv_gv_device_is_controller", self._handle):
            raise Busy(
                f"another program has the camera {device}: close that program first"
                " (one that was killed holds it for three more seconds)"
            )
        if not self._settings.packet_socket:
            self._aravis.call("arv_camera_gv_set_stream_options", self._camera, PACKET_SOCKET_DISABLED)
        self.call("arv_camera_gv_set_packet_size", self._settings.packet_size or _SAFE_PACKET_BYTES)
        if self._settings.packet_size is None:  # tries larger ones, if the camera sends test packets
            self.call("arv_camera_gv_auto_packet_size", timeout_s=_OPENING_S)

    def _check_control(self) -> None:
        """Raise `Disconnected` if another program took the camera, or it restarted."""
        if self.is_gige and not self._aravis.call("arv_gv_device_is_controller", self._handle):
            raise Disconnected("the camera is no longer under control: it was switched off, or another program has it")


def chosen(wanted: str) -> str:
    """Return Aravis's identifier of a camera by name, serial number or address, "" for the only one."""
    with suppress(ValueError):
        return str(ip_address(wanted))  # perhaps in another network, beyond the reach of a discovery
    aravis = load_aravis()
    listed = _listed(aravis) if wanted else []  # by an earlier discovery: reopening need not wait for another
    if not any(wanted in names for names in listed):
        update_list(aravis)
        listed = _listed(aravis)
    return listed[choose(wanted, listed, what="GenICam camera", setting="camera.device")][0]


def update_list(aravis: Aravis) -> None:
    """Search for cameras."""
    calls = CallThread("genicam discovery")
    try:
        calls.call_within(lambda: aravis.call("arv_update_device_list"), _DISCOVERY_S)
    finally:
        calls.end()


def _listed(aravis: Aravis) -> list[tuple[str, str]]:
    """Identifier and serial number of each listed camera."""
    calls = ("arv_get_device_id", "arv_get_device_serial_nbr")
    return [tuple(aravis.call(call, i) for call in calls) for i in range(aravis.call("arv_get_n_devices"))]

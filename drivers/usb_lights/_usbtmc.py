"""USB Test and Measurement Class (USBTMC 1.0, USB-IF 2003): text messages, over pyusb.

Each transfer has a header of 12 bytes: type, a tag that the answer repeats, length, end of message. After a timeout the
transfer is aborted and the buffers are cleared: otherwise a late answer would be taken for that of the next query.
"""

import errno
import struct
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec

import usb.backend.libusb1
import usb.core
import usb.util
from usb.backend import IBackend

from drivers.errors import Busy, DeviceError, DeviceTimeout, Disconnected, Unsupported, attempt

_CLASS, _SUBCLASS = 0xFE, 0x03
_OUT, _REQUEST_IN, _IN = 1, 2, 2  # transfer types: message, request for one, answer
_END_OF_MESSAGE = 1
_HEADER = struct.Struct("<BBBxLB3x")
_ABORT_OUT, _ABORT_IN, _CHECK_ABORT = 1, 3, 1  # the check of each has the next number
_CLEAR, _CHECK_CLEAR, _CAPABILITIES = 5, 6, 7
_REMOTE, _LOCAL = 160, 161  # REN_CONTROL and GO_TO_LOCAL of the subclass USB488, which come together
_OPENINGS = 3  # some instruments miss the first
_INTERFACE, _ENDPOINT = 0xA1, 0xA2  # recipients of class requests
_SUCCESS, _PENDING = 0x01, 0x02
_GONE = {errno.ENODEV, errno.ENXIO, errno.ENOENT, errno.EIO, errno.EPROTO, errno.ESHUTDOWN}
_TIMEOUT_MS, _CONTROL_MS, _EMPTY_MS = 3000, 500, 50
_POLLS, _POLL_S = 20, 0.02  # of a pending abort or clear
_LARGEST = 4096 - _HEADER.size  # bytes of data in a transfer
_LONGEST_ANSWER = 1 << 20
UDEV_FILE = "/etc/udev/rules.d/70-svwfs.rules"
UDEV_RULE = 'SUBSYSTEM=="usb", ATTR{idVendor}=="1313", TAG+="uaccess"'  # of Thorlabs


@dataclass(frozen=True, slots=True)
class UsbInstrument:
    """An instrument on the bus."""

    serial_number: str
    device: usb.core.Device
    problem: str = ""  # reason why its serial number is unknown


def instruments(vendor_id: int, product_ids: Collection[int], backend: IBackend | None = None) -> list[UsbInstrument]:
    """Return the instruments of this vendor and these products; reads only their serial numbers."""
    try:
        with _faults("the USB bus"):
            devices = usb.core.find(find_all=True, idVendor=vendor_id, backend=backend or _backend())
            return [_identify(device) for device in devices if device.idProduct in product_ids]
    except usb.core.NoBackendError as error:
        raise Unsupported(
            "USB instruments need the library libusb 1.0; install it (Debian, Ubuntu: apt install libusb-1.0-0;"
            " macOS: brew install libusb; Windows: the extra usb of svwfs)"
        ) from error


def _backend() -> IBackend | None:
    """The system's libusb, else that of the extra `usb`; None for pyusb's other libraries."""
    if (system := usb.backend.libusb1.get_backend()) is not None or find_spec("libusb_package") is None:
        return system
    return usb.backend.libusb1.get_backend(find_library=import_module("libusb_package").find_library)


def _identify(device: usb.core.Device) -> UsbInstrument:
    try:
        with _faults(f"the USB device {device.idVendor:04x}:{device.idProduct:04x}"):
            usb.util.get_string(device, device.iSerialNumber, 0x0409)  # in English; raises the reason of a failure
            return UsbInstrument(device.serial_number or "", device)
    except DeviceError as error:
        return UsbInstrument("", device, str(error))


class Usbtmc:
    """A connection to one instrument; every fault is raised as a `DeviceError`."""

    def __init__(self, instrument: UsbInstrument, *, what: str, sleep: Callable[[float], None] = time.sleep) -> None:
        """`what` names it in errors; `sleep` waits between polls."""
        self._device, self._what, self._sleep = instrument.device, what, sleep
        self._tag = 0
        self._is_remote = False
        self._detached: int | None = None  # interface that a kernel driver had
        for opening in range(1, _OPENINGS + 1):
            try:
                self._open()
                break
            except DeviceError as error:
                self.close()
                if opening == _OPENINGS or not isinstance(error, DeviceTimeout):
                    raise

    def _open(self) -> None:
        """Claim the instrument, put it under remote control, and empty its buffers."""
        with _faults(self._what):
            self._claim()
        if self._require(_CAPABILITIES, 24, "report its capabilities")[14] & 2:  # it takes this request
            self._is_remote = True  # even if its answer is lost
            self._control(_REMOTE, 1, 1)
        self.clear()

    def write(self, message: str) -> None:
        """Send one message."""
        data = message.encode("ascii")
        with self._recovered(_ABORT_OUT):
            for start in range(0, len(data), _LARGEST):
                part = data[start : start + _LARGEST]
                attributes = _END_OF_MESSAGE if start + _LARGEST >= len(data) else 0
                self._send(_OUT, len(part), attributes, part)

    def read(self) -> str:
        """Return one message, of one or more transfers."""
        message, is_complete = b"", False
        with self._recovered(_ABORT_IN):
            while not is_complete:
                data, is_complete = self._read_transfer()
                message += data
                if len(message) > _LONGEST_ANSWER:
                    raise DeviceError(f"{self._what} sends an endless answer")
        return message.decode("ascii", "backslashreplace").strip()

    def query(self, message: str) -> str:
        """Send a query and return the answer."""
        self.write(message)
        return self.read()

    def clear(self) -> None:
        """Empty the instrument's input and output buffers."""
        self._require(_CLEAR, 1, "clear its buffers")
        for _ in range(_POLLS):
            status, has_more = self._control(_CHECK_CLEAR, 0, 2)[:2]
            if status == _SUCCESS:
                with _faults(self._what):
                    self._device.clear_halt(self._out)
                return
            if has_more & 1:
                self._drain()
            else:
                self._sleep(_POLL_S)
        raise DeviceTimeout(f"{self._what} does not finish clearing its buffers; switch it off and on")

    def close(self) -> None:
        """Release it, in any state: to its front panel, and to the kernel driver that it was taken from."""
        for request in (_LOCAL, _REMOTE) if self._is_remote else ():
            with suppress(DeviceError):  # it may be gone
                self._control(request, 0, 1)
        self._is_remote = False
        detached, self._detached = self._detached, None
        with suppress(OSError, ValueError, NotImplementedError):
            usb.util.dispose_resources(self._device)
            if detached is not None:
                self._device.attach_kernel_driver(detached)
                usb.util.dispose_resources(self._device)  # which attaching has opened again

    def _claim(self) -> None:
        """Claim the USBTMC interface, from a kernel driver if need be, and find its endpoints."""
        try:
            configuration = self._device.get_active_configuration()
        except usb.core.USBError as error:
            if error.errno in {errno.EACCES, *_GONE}:
                raise
            self._device.set_configuration()
            configuration = self._device.get_active_configuration()
        interface = usb.util.find_descriptor(configuration, bInterfaceClass=_CLASS, bInterfaceSubClass=_SUBCLASS)
        if interface is None:
            raise Unsupported(f"{self._what} has no USB measurement interface; is it in its firmware update mode?")
        self._interface = interface.bInterfaceNumber
        with suppress(NotImplementedError):  # only Linux has kernel drivers to detach
            if self._device.is_kernel_driver_active(self._interface):
                self._device.detach_kernel_driver(self._interface)
                self._detached = self._interface
        usb.util.claim_interface(self._device, self._interface)
        bulk = [end for end in interface if usb.util.endpoint_type(end.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK]
        ways = {usb.util.endpoint_direction(end.bEndpointAddress): end for end in bulk}
        self._out = ways[usb.util.ENDPOINT_OUT].bEndpointAddress
        self._in = ways[usb.util.ENDPOINT_IN].bEndpointAddress
        self._packet_size = ways[usb.util.ENDPOINT_IN].wMaxPacketSize & 0x7FF

    def _send(self, kind: int, length: int, attributes: int, data: bytes = b"") -> None:
        self._tag = self._tag % 255 + 1
        transfer = _HEADER.pack(kind, self._tag, ~self._tag & 0xFF, length, attributes) + data
        with _faults(self._what):
            self._device.write(self._out, transfer + bytes(-len(transfer) % 4), _TIMEOUT_MS)

    def _read_transfer(self) -> tuple[bytes, bool]:
        """Return the data of one transfer; True if the message ends with it."""
        self._send(_REQUEST_IN, _LARGEST, 0)
        packet = transfer = self._packet(_TIMEOUT_MS)
        if len(transfer) < _HEADER.size:
            raise DeviceError(f"{self._what} answered with half a header")
        kind, tag, inverse, length, attributes = _HEADER.unpack_from(transfer)
        if (kind, tag, inverse) != (_IN, self._tag, ~self._tag & 0xFF) or length > _LARGEST:
            raise DeviceError(f"{self._what} answered another query than the last")
        while len(packet) == self._packet_size and len(transfer) < _HEADER.size + length:
            packet = self._packet(_TIMEOUT_MS)
            transfer += packet
        if len(packet) == self._packet_size:  # some instruments send an empty packet next
            with suppress(DeviceTimeout):
                self._packet(_EMPTY_MS)
        if len(transfer) < _HEADER.size + length:
            raise DeviceError(f"{self._what} sent half an answer")
        return transfer[_HEADER.size : _HEADER.size + length], bool(attributes & _END_OF_MESSAGE)

    def _packet(self, timeout_ms: int) -> bytes:
        with _faults(self._what):
            return bytes(self._device.read(self._in, self._packet_size, timeout_ms))

    @contextmanager
    def _recovered(self, abort: int) -> Iterator[None]:
        """After a failed transfer, abort it and clear all buffers, so that the next query works."""
        try:
            yield
        except Disconnected:
            raise
        except DeviceError:
            attempt(self._recover, abort)  # the original error says more than another one
            raise

    def _recover(self, abort: int) -> None:
        with suppress(DeviceTimeout):  # clearing includes what an abort does
            self._abort(abort)
        self.clear()

    def _abort(self, request: int) -> None:
        endpoint, is_in = (self._in, True) if request == _ABORT_IN else (self._out, False)
        if self._control(request, self._tag, 2, endpoint)[0] == _SUCCESS:
            if is_in:
                self._drain()
            for _ in range(_POLLS):
                answer = self._control(request + _CHECK_ABORT, 0, 8, endpoint)
                if answer[0] != _PENDING:
                    break
                if is_in and answer[1] & 1:
                    self._drain()
                else:
                    self._sleep(_POLL_S)
        if not is_in:
            with _faults(self._what):
                self._device.clear_halt(endpoint)

    def _drain(self) -> None:
        """Read up to a short packet, which ends a transfer."""
        with suppress(DeviceTimeout):
            while len(self._packet(_CONTROL_MS)) == self._packet_size:
                pass

    def _require(self, request: int, length: int, what: str) -> bytes:
        answer = self._control(request, 0, length)
        if answer[0] != _SUCCESS:
            raise DeviceError(f"{self._what} does not {what}; switch it off and on")
        return answer

    def _control(self, request: int, value: int, length: int, endpoint: int | None = None) -> bytes:
        kind, index = (_INTERFACE, self._interface) if endpoint is None else (_ENDPOINT, endpoint)
        with _faults(self._what):
            answer = bytes(self._device.ctrl_transfer(kind, request, value, index, length, _CONTROL_MS))
        if len(answer) < length:
            raise DeviceError(f"{self._what} answered a request of the USB class with {len(answer)} of {length} bytes")
        return answer


@contextmanager
def _faults(what: str) -> Iterator[None]:
    try:
        yield
    except usb.core.NoBackendError:
        raise
    except usb.core.USBTimeoutError as error:
        raise DeviceTimeout(f"{what} did not answer in time; is it busy, or hung?") from error
    except (OSError, ValueError, LookupError, NotImplementedError) as error:  # USBError is an OSError
        raise _translate(what, error) from error


def _translate(what: str, error: Exception) -> DeviceError:
    number = error.errno if isinstance(error, OSError) else None
    if number in _GONE:
        return Disconnected.of(what)
    if number == errno.EBUSY:
        return Busy(f"another program holds {what}; close it")
    if number in {errno.EACCES, errno.EPERM}:
        return DeviceError(
            f"you may not use {what}: as root, add the line “{UDEV_RULE}” to {UDEV_FILE}, run"
            " “udevadm control --reload” and plug it in again"
        )
    if isinstance(error, NotImplementedError):
        return Unsupported(f"{what} has no driver that libusb can use; on Windows, give it WinUSB by the program Zadig")
    return DeviceError(f"the connection to {what} failed: {error}")

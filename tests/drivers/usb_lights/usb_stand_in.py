"""A pyusb backend with stand-in instruments, in place of libusb."""

from __future__ import annotations

import array
import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import usb.core
from support.stand_ins.usbtmc import GoneError, NoAnswerError, StalledError, UsbtmcWire
from usb.backend import IBackend

from simulated_devices.clock import ManualClock

OUT, IN = 0x01, 0x82


class Plug:
    """An instrument on the bus."""

    def __init__(self, wire: UsbtmcWire, serial_number: str, product_id: int = 0x80C8) -> None:
        self.wire, self.serial_number, self.product_id = wire, serial_number, product_id
        self.is_allowed = self.has_driver = True
        self.is_taken = False  # by another program
        self.has_kernel_driver = True
        self.is_claimed = False
        self.is_configured = True


class Bus(IBackend):  # type: ignore[misc] # pyusb has no types
    """The bus; timeouts advance the manual clock."""

    def __init__(self, *plugs: Plug, clock: ManualClock) -> None:
        self.plugs, self.clock = list(plugs), clock

    def enumerate_devices(self) -> Iterator[Plug]:
        return iter([plug for plug in self.plugs if not plug.wire.is_unplugged])

    def get_parent(self, _dev: Plug) -> None:
        return None

    def get_device_descriptor(self, dev: Plug) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0200,
            bDeviceClass=0,
            bDeviceSubClass=0,
            bDeviceProtocol=0,
            bMaxPacketSize0=64,
            idVendor=0x1313,
            idProduct=dev.product_id,
            bcdDevice=0x0100,
            iManufacturer=1,
            iProduct=2,
            iSerialNumber=3,
            bNumConfigurations=1,
            address=5,
            bus=1,
            port_number=1,
            port_numbers=(1,),
            speed=2,
        )

    def get_configuration_descriptor(self, _dev: Plug, config: int) -> SimpleNamespace:
        _check_index(config, 1)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=39,
            bNumInterfaces=1,
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0xC0,
            bMaxPower=0,
            extra_descriptors=[],
        )

    def get_interface_descriptor(self, dev: Plug, intf: int, alt: int, config: int) -> SimpleNamespace:
        _check_index(intf, 1)
        _check_index(alt, 1)
        _check_index(config, 1)
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=0,
            bAlternateSetting=0,
            bNumEndpoints=3,
            bInterfaceClass=0xFE,
            bInterfaceSubClass=0x01 if dev.product_id == 0x80C0 else 0x03,  # firmware update, or measurement
            bInterfaceProtocol=1,
            iInterface=0,
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(self, _dev: Plug, ep: int, _intf: int, _alt: int, _config: int) -> SimpleNamespace:
        _check_index(ep, 3)
        address, attributes = [(0x83, 3), (OUT, 2), (IN, 2)][ep]  # interrupt, bulk, bulk
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=address,
            bmAttributes=attributes,
            wMaxPacketSize=64,
            bInterval=1,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=[],
        )

    def open_device(self, dev: Plug) -> Plug:
        if not dev.has_driver:
            raise NotImplementedError("Operation not supported or unimplemented on this platform")
        if not dev.is_allowed:
            raise usb.core.USBError("Access denied (insufficient permissions)", -3, errno.EACCES)
        with _translated():
            dev.wire._check()
        return dev

    def close_device(self, _dev_handle: Plug) -> None:
        pass

    def set_configuration(self, dev_handle: Plug, _config_value: int) -> None:
        dev_handle.is_configured = True

    def get_configuration(self, dev_handle: Plug) -> int:
        return 1 if dev_handle.is_configured else 0

    def claim_interface(self, dev_handle: Plug, _intf: int) -> None:
        if dev_handle.is_taken or dev_handle.has_kernel_driver:
            raise usb.core.USBError("Resource busy", -6, errno.EBUSY)
        dev_handle.is_claimed = True

    def release_interface(self, dev_handle: Plug, _intf: int) -> None:
        dev_handle.is_claimed = False

    def is_kernel_driver_active(self, dev_handle: Plug, _intf: int) -> bool:
        return dev_handle.has_kernel_driver

    def detach_kernel_driver(self, dev_handle: Plug, _intf: int) -> None:
        dev_handle.has_kernel_driver = False

    def attach_kernel_driver(self, dev_handle: Plug, _intf: int) -> None:
        if dev_handle.is_claimed:
            raise usb.core.USBError("Resource busy", -6, errno.EBUSY)
        dev_handle.has_kernel_driver = True

    def clear_halt(self, dev_handle: Plug, _ep: int) -> None:
        with _translated():
            dev_handle.wire.clear_halt()

    def bulk_write(self, dev_handle: Plug, ep: int, _intf: int, data: array.array[int], timeout: int) -> int:
        assert ep == OUT
        with _translated(lambda: self.clock.sleep(timeout / 1000)):
            dev_handle.wire.bulk_out(data.tobytes())
        return len(data)

    def bulk_read(self, dev_handle: Plug, ep: int, _intf: int, buff: array.array[int], timeout: int) -> int:
        assert ep == IN
        assert len(buff) % 64 == 0, "a read that is no multiple of the packet size can overflow"
        with _translated(lambda: self.clock.sleep(timeout / 1000)):
            data = dev_handle.wire.bulk_in(len(buff))
        buff[: len(data)] = array.array("B", data)
        return len(data)

    def ctrl_transfer(  # noqa: PLR0917 - pyusb's signature
        self,
        dev_handle: Plug,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array.array[int],
        timeout: int,
    ) -> int:
        with _translated(lambda: self.clock.sleep(timeout / 1000)):
            if (bmRequestType, bRequest) == (0x80, 6):
                dev_handle.wire._check()
                answer = _string(wValue & 0xFF, dev_handle.serial_number)
            else:
                answer = dev_handle.wire.control(bmRequestType, bRequest, wValue, wIndex, len(data))
        data[: len(answer)] = array.array("B", answer[: len(data)])
        return min(len(answer), len(data))


def _string(index: int, serial_number: str) -> bytes:
    text = {1: "Thorlabs", 2: "DC2200", 3: serial_number}.get(index)
    body = b"\x09\x04" if text is None else text.encode("utf-16-le")
    return bytes([len(body) + 2, 3]) + body


def _check_index(index: int, count: int) -> None:
    if index >= count:
        raise IndexError


@contextmanager
def _translated(wait: Callable[[], Any] = lambda: None) -> Iterator[None]:
    """Raise a fault of the wire as libusb does."""
    try:
        yield
    except NoAnswerError as error:
        wait()
        raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT) from error
    except StalledError as error:
        raise usb.core.USBError("Pipe error", -9, errno.EPIPE) from error
    except GoneError as error:
        raise usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV) from error

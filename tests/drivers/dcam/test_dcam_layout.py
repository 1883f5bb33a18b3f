"""Binary interface of the DCAM-API: structure layouts, prototypes, error codes, library faults."""

from __future__ import annotations

import ctypes
import os
import subprocess
from pathlib import Path

import pytest
from support.dcam_tools import compiling
from support.stand_ins.dcam.build import SOURCES, build_program

from drivers.dcam import _library as library
from drivers.dcam._library import ERRORS, PROTOTYPES, DcamLibrary, Denied, NotThere, error_of
from drivers.errors import BadValue, Busy, DeviceError, DeviceTimeout, Disconnected, FrameLost, Unsupported, WrongState

# Name in C, size and some offsets, as gcc gave them for Hamamatsu's own header with 64-bit pointers.
LAYOUTS: dict[type[ctypes.Structure], tuple[str, int, dict[str, int]]] = {
    library.Init: ("DCAMAPI_INIT", 32, {"iDeviceCount": 4, "initoption": 16, "guid": 24}),
    library.DeviceOpen: ("DCAMDEV_OPEN", 16, {"index": 4, "hdcam": 8}),
    library.DeviceString: ("DCAMDEV_STRING", 24, {"iString": 4, "text": 8, "textbytes": 16}),
    library.PropertyAttribute: (
        "DCAMPROP_ATTR",
        88,
        {"iProp": 4, "attribute": 16, "valuemin": 32, "valuedefault": 56, "nMaxChannel": 64, "iPropStep_Element": 84},
    ),
    library.PropertyValueText: ("DCAMPROP_VALUETEXT", 32, {"value": 8, "text": 16, "textbytes": 24}),
    library.TimeStamp: ("DCAM_TIMESTAMP", 8, {"sec": 0, "microsec": 4}),
    library.TransferInfo: ("DCAMCAP_TRANSFERINFO", 16, {"nNewestFrameIndex": 8, "nFrameCount": 12}),
    library.BufferFrame: (
        "DCAMBUF_FRAME",
        64,
        {"iFrame": 12, "buf": 16, "rowbytes": 24, "timestamp": 48, "framestamp": 56, "camerastamp": 60},
    ),
    library.WaitOpen: ("DCAMWAIT_OPEN", 24, {"supportevent": 4, "hwait": 8, "hdcam": 16}),
    library.WaitStart: ("DCAMWAIT_START", 16, {"eventhappened": 4, "eventmask": 8, "timeout": 12}),
}


def layout(kind: type[ctypes.Structure]) -> dict[str, int]:
    return {field[0]: getattr(kind, field[0]).offset for field in kind._fields_}


@pytest.mark.parametrize("kind", LAYOUTS)
def test_structures_match_vendor_header(kind: type[ctypes.Structure]) -> None:
    _, size, offsets = LAYOUTS[kind]
    assert ctypes.sizeof(kind) == size
    assert layout(kind).items() >= offsets.items()


@pytest.mark.posix  # compiles
def test_structures_match_c_compiler(tmp_path: Path) -> None:
    lines = []
    for kind, (name, _, _) in LAYOUTS.items():
        lines.append(f'printf("{name} size %zu\\n", sizeof({name}));')
        lines += [f'printf("{name} {field} %zu\\n", offsetof({name}, {field}));' for field in layout(kind)]
    source = tmp_path / "layout.c"
    headers = "#include <stddef.h>\n#include <stdio.h>\n#include <dcamapi.h>\n"
    source.write_text(headers + "int main(void) {" + "\n".join(lines) + "}")
    with compiling():
        program = build_program(source, tmp_path)
    output = subprocess.run([program], capture_output=True, text=True, check=True).stdout  # noqa: S603 - just made
    expected = "".join(
        f"{name} size {ctypes.sizeof(kind)}\n"
        + "".join(f"{name} {field} {offset}\n" for field, offset in layout(kind).items())
        for kind, (name, _, _) in LAYOUTS.items()
    )
    assert output == expected


def test_every_function_has_a_prototype() -> None:
    header = (SOURCES / "dcamapi.h").read_text()
    assert all(f"{name}(" in header for name in PROTOTYPES)
    assert header.count("DCAM_EXPORT int32_t") == len(PROTOTYPES)


# Codes by error: each needs another reaction at the bench.
MEANINGS: dict[type[DeviceError], list[int]] = {
    DeviceTimeout: [0x80000106, 0x80000303],
    FrameLost: [0x80000301, 0x80000F06, 0x80000321, 0x80000305, 0x80000833],
    Disconnected: [
        *[0x80000F07, 0x83001002, 0x83001003, 0x80000807, 0x80000F01],
        *[0x80000206, 0x80000806, 0x80000F04, 0x84002001],
    ],
    WrongState: [0x80000101, 0x80000102, 0x80000103, 0x80000104, 0x80000105, 0x80000107],
    Denied: [0x8000082C],
    BadValue: [0x80000808, 0x80000821, 0x80000822, 0x8000082B, 0x8000082E],
    Unsupported: [
        *[0x80000F02, 0x80000F03, 0x80000823, 0x80000824, 0x80000825, 0x80000828],
        *[0x80000204, 0x80000205, 0x80000207, 0x80000211, 0x80000832, 0x84002002],
    ],
    Busy: [0x80000110, 0x81001001, 0x82001001],
    DeviceError: [0x80000201, 0x80000203, 0x8000083F, 0x80000302, 0x80000304],
}


def test_every_error_code_is_translated() -> None:
    assert sorted(ERRORS) == sorted(code for codes in MEANINGS.values() for code in codes)
    for kind, codes in MEANINGS.items():
        for code in codes:
            error = error_of(code - 2**32, "dcamcap_start")  # as ctypes returns it
            assert type(error) in {kind, NotThere}
            assert isinstance(error, kind)
            assert f"{code:08x}" in str(error)
            assert "dcamcap_start" in str(error)


def test_unknown_error_code_is_shown() -> None:
    error = error_of(-0x12345678, "dcamprop_getvalue")
    assert type(error) is DeviceError
    assert "edcba988" in str(error)


def test_missing_library_says_what_to_install(tmp_path: Path) -> None:
    with pytest.raises(Unsupported, match="install it from Hamamatsu"):
        DcamLibrary(str(tmp_path / "dcamapi.dll"))


def test_wrong_library_is_refused() -> None:
    with pytest.raises(Unsupported, match="dcamapi_init"):
        DcamLibrary("libc.so.6" if os.name == "posix" else "kernel32.dll")


def test_library_crash_becomes_device_error() -> None:
    library = object.__new__(DcamLibrary)

    def crash(*_: object) -> int:
        raise OSError("exception: access violation reading 0x0")

    library._functions = {"dcamcap_start": crash}
    with pytest.raises(Disconnected, match="access violation"):
        library.call("dcamcap_start", 1)

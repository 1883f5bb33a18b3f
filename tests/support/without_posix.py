"""Python without what Windows lacks; as a plugin of pytest, it hides that before any test is loaded."""

from __future__ import annotations

import importlib
import os
import select
import signal
import socket
import sys

import pytest

_PACKAGES = (
    "cv2 distributed h5netcdf h5py hypothesis jsonschema matplotlib.pyplot mm_test_adapters numba psutil"
    " pyqtgraph pymmcore PyQt6.QtTest PyQt6.QtWidgets"
    " rich scipy.optimize serial.tools.list_ports SimpleITK skimage tifffile typer"
    " usb.backend.libusb0 usb.backend.libusb1 usb.backend.openusb usb.core xarray zarr zmq"
)
_MODULES = "fcntl grp posix pty pwd resource syslog termios tty"
_NAMES = {
    os: "fork forkpty getuid geteuid getpgid killpg mkfifo nice openpty O_DIRECTORY O_NOFOLLOW O_NONBLOCK setpriority"
    " setsid sched_getaffinity statvfs sysconf",
    select: "poll epoll",
    signal: "SIGHUP SIGKILL SIGALRM SIGBUS SIGCHLD SIGCONT SIGPIPE SIGQUIT SIGSTOP SIGUSR1 SIGUSR2 alarm pthread_kill"
    " setitimer",
    socket: "AF_UNIX",
}


def hide_posix() -> None:
    """Hide what Windows lacks, after loading the packages of others."""
    for name in _PACKAGES.split():
        importlib.import_module(name)
    for name in _MODULES.split():
        sys.modules[name] = None  # type: ignore[assignment] # importing it fails
    for module, names in _NAMES.items():
        for name in names.split():
            if hasattr(module, name):
                delattr(module, name)


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests() -> None:
    """Hide it before the tests' own files are loaded; svwfs itself sees that this is Linux."""
    for name in ("app.acquisition.address", "drivers.serial_lights._line"):
        importlib.import_module(name)
    hide_posix()

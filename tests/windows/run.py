"""`make windows`: the table of `check.py`, or the tests, on a Windows Python under Wine, beside stand-ins on Linux."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from support.light_log import LightLog
from support.paths import FOREIGN_FRAMES, ROOT
from support.stand_ins.dc4100 import DC4100Wire
from support.stand_ins.dcam.build import SOURCES
from support.stand_ins.pseudo_terminal import PtyServer

from windows.prepare import prepare
from windows.shim import COMPILER

_HERE = Path(__file__).parent
_PYTHON = "Z:\\win\\python\\python.exe"
_VARIABLES = {
    "NUMBA_CACHE_DIR": "Z:\\win\\numba",
    "SVWFS_RUNTIME_DIR": "Z:\\win\\check",
    "MPLCONFIGDIR": "Z:\\win\\check",
}
_VARIABLES_OF_TESTS = {
    "PYTHONPATH": "Z:\\checkout",
    "PYTHONPYCACHEPREFIX": "Z:\\win\\pycache",
    "OPENBLAS_NUM_THREADS": "1",
    "SVWFS_DCAM_STAND_IN": "Z:\\win\\check\\dcamapi.dll",
    "WINEQT_QPA_PLATFORM": "offscreen",  # which has no fonts of its own
    "WINEQT_QPA_FONTDIR": "Z:\\win\\python\\Lib\\site-packages\\matplotlib\\mpl-data\\fonts\\ttf",
}
_BENCH = """
[camera]
driver = "dcam"
library = 'Z:\\win\\check\\dcamapi.dll'
exposure_s = 0.02

[light]
driver = "thorlabs_dc4100"
port = "COM5"
current_a = 0.1
"""


class _FileLog(LightLog):
    """Notes changes in a file, too, with the time of all programs of this computer."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        path.write_text(f"{time.time()} False\n")

    def note(self, *, is_on: bool, level: float, time_s: float | None = None) -> None:
        was_on = self.is_lit
        super().note(is_on=is_on, level=level, time_s=time_s)
        if is_on != was_on:
            with self._path.open("a") as file:
                file.write(f"{time.time()} {is_on}\n")


def main(cache: Path) -> int:
    """Prepare the cache, install this checkout, and run the table, or with TESTS=1 the tests."""
    prepare(cache)
    folder = cache / "win" / "check"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    prefix = os.environ.setdefault("WINEPREFIX", "/win/prefix")
    if not (cache / prefix.lstrip("/")).exists():
        _wine(cache, "sh", "-c", "wineboot -i 2>/dev/null; wineserver -w")
    (wheel,) = (cache / "win" / "wheel").glob("*.whl")
    wheel_there = f"Z:\\win\\wheel\\{wheel.name}"
    pip = f"-m pip install --quiet --no-index --no-deps --force-reinstall --no-warn-script-location {wheel_there}"
    installed = _wine(cache, "wine", _PYTHON, *pip.split())
    if installed:
        return installed
    _compile_camera(cache, folder)
    if os.environ.get("TESTS"):
        return _run_tests(cache, f"tests/{os.environ.get('ROOM', '')}")
    (folder / "lab.toml").write_text((FOREIGN_FRAMES / "bench.toml").read_text() + _BENCH)
    shutil.copy(_HERE / "check.py", folder)
    lamp = DC4100Wire()
    lamp.log = _FileLog(folder / "light.log")
    with PtyServer(lamp) as server:
        port = f"wine reg add 'HKLM\\Software\\Wine\\Ports' /v COM5 /d {server.port} /f >/dev/null"
        _wine(cache, "sh", "-c", f"{port}; wineserver -k; wineserver -w")  # which writes it down
        # Hamamatsu installs its library where Windows looks for all.
        script = "cp /win/check/dcamapi.dll $WINEPREFIX/drive_c/windows/system32"
        script += "; Xvfb :77 -screen 0 1600x1000x24 -fbdir /win/check >/dev/null 2>&1 & sleep 1"
        script += f"; wine '{_PYTHON}' 'Z:\\win\\check\\check.py' 'Z:\\win\\check'"
        return _wine(cache, "DISPLAY=:77", "sh", "-c", script)


def _run_tests(cache: Path, room: str) -> int:
    chosen = f"-q -m 'not slow' -p no:cacheprovider {room}"
    variables = [f"{name}={value}" for name, value in _VARIABLES_OF_TESTS.items()]
    return _wine(cache, *variables, "sh", "-c", f"cd /checkout && wine '{_PYTHON}' -m pytest {chosen}")


def _wine(cache: Path, *command: str) -> int:
    chosen = {name: os.environ[name] for name in ("ONLY", "DEATHS", "SAID", "PYTEST_ADDOPTS") if name in os.environ}
    variables = [f"{name}={value}" for name, value in (_VARIABLES | chosen).items()]
    whole = [str(_HERE / "wine.sh"), str(cache), "env", *variables, *command]
    return subprocess.run(whole, cwd=ROOT, check=False).returncode  # noqa: S603 - our own


def _compile_camera(cache: Path, folder: Path) -> None:
    work = folder / "dcam"
    shutil.copytree(SOURCES, work)
    # Conditions of MinGW's threads know no other clock.
    options = "-std=c11 -O2 -D_POSIX_C_SOURCE=200809L -DCLOCK_MONOTONIC=CLOCK_REALTIME"
    script = f"cd /win/check/dcam && {COMPILER} {options} -shared -static *.c -lpthread -o ../dcamapi.dll"
    subprocess.run([_HERE / "wine.sh", cache, "sh", "-c", script], check=True)  # noqa: S603 - our own


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))

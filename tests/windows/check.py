"""Every command and every death of an instrument on Windows, as a table; the exit status is 1 if a line fails.

It runs on the Python of Windows into which svwfs was installed, as `python check.py FOLDER`. The folder has the DLL of
the DCAM stand-in and `light.log`, in which the stand-in of the light at COM5 notes its changes.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

FOLDER = Path(sys.argv[1])
WORK = FOLDER / "work"
ADDRESS = FOLDER / "svwfs" / "instrument.json"
SCRIPTS = Path(sys.prefix, "Scripts")
PATIENCE_S = 240.0  # until a command has ended, or what is awaited has come
LIT_S = 1.0  # without a change, and the light shines for good
DEATHS = int(os.environ.get("DEATHS", "400"))  # of parents of a watchdog's pipe
_AT_ONCE = 20  # of these
_SAID = int(os.environ.get("SAID", "1"))  # lines that a command which failed said last

CLIENT = """
import svwfs, sys
from itertools import islice
with svwfs.connect() as instrument:
    newest = next(iter(instrument))
    print("one", newest.wavefront.views.shape, sum(1 for _ in islice(instrument.every(), 5)), flush=True)
    instrument.record(sys.argv[1], frames=5)
    instrument.shut_down()
"""
WATCHES = """
import svwfs
with svwfs.connect(watch=True) as instrument:
    print(next(iter(instrument)).wavefront.views.shape)
"""
STILL_MEASURES = """
import svwfs
from itertools import islice
with svwfs.connect() as instrument:
    print(sum(1 for _ in islice(instrument.every(), 5)))
    instrument.shut_down()
"""
ASKED = """
import sys, time
from pathlib import Path
from app.acquisition.remote.connection import reach
from app.errors import RunError
from app.run_facts import MAIN
from reconstruction.runtime.child_process import ask_to_end, start_child

def reached():
    while child.poll() is None:
        try:
            return reach("asked")
        except RunError:
            time.sleep(0.1)
    sys.exit("it has ended")

with open("asked.log", "wb") as log:
    child = start_child(MAIN, "serve", "--bench", "small_demo", output=log)
try:
    connection = reached()
    while connection.newest is None or connection.newest.wavefront is None:
        time.sleep(0.05)
    connection.start_recording(Path(sys.argv[1])).result()
    time.sleep(1)
    ask_to_end(child)
    print(child.wait(60))
finally:
    child.kill()
"""
PARENT = f"""
import sys, time
from reconstruction.runtime.child_process import start_child
code = "from app.acquisition.watchdog import _Pipe\\npipe = _Pipe()\\nwhile not pipe.has_ended: pipe.next(0.05)"
children = [start_child(code) for _ in range({_AT_ONCE})]
for child in children:
    child.stdout.readline()
print(*(child.pid for child in children), flush=True)
time.sleep(600)
"""
GIGE_CAMERA = """
import ctypes, time
from drivers.genicam._library import load_library

aravis = load_library()[0]
aravis.arv_gv_fake_camera_new.restype = ctypes.c_void_p
camera = ctypes.c_void_p(aravis.arv_gv_fake_camera_new(b"127.0.0.1", b"svwfs"))
assert camera and aravis.arv_gv_fake_camera_is_running(camera)
time.sleep(600)
"""
GIGE_BENCH = """
[camera]
driver = "genicam"
device = "127.0.0.1"
exposure_s = 0.01
frame_rate_hz = 25.0
region = { top = 8, left = 16, rows = 96, columns = 128 }

[light]
driver = "manual"
"""
CLOSE_CONSOLE = """
import ctypes, sys, time
windows, user = ctypes.windll.kernel32, ctypes.windll.user32
user.PostMessageW.argtypes = [ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p]
windows.GetConsoleWindow.restype = ctypes.c_void_p
windows.FreeConsole()
assert windows.AttachConsole(int(sys.argv[1])), "no console"
window = windows.GetConsoleWindow()
windows.FreeConsole()
assert window, "no window"
print(time.time(), flush=True)
assert user.PostMessageW(window, 0x10, None, None), "not posted"  # WM_CLOSE
"""


class Failed(Exception):
    """A line of the table fails, with the reason."""


def svwfs(*arguments: object) -> str:
    """Run a command to its end; return what it printed."""
    return run([SCRIPTS / "svwfs.exe", *arguments])


def python(code: str, *arguments: object) -> str:
    """Run some Python to its end; return what it printed."""
    return run([sys.executable, "-c", code, *arguments])


def run(command: list[Any]) -> str:
    try:
        done = subprocess.run(  # noqa: S603 - our own
            [str(part) for part in command],
            input=b"\n",  # agrees to what is asked
            capture_output=True,
            timeout=PATIENCE_S,
            cwd=WORK,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise Failed(f"it hangs: nothing after {PATIENCE_S:g} s") from error
    said = (done.stdout + done.stderr).decode(errors="replace")
    if done.returncode:
        raise Failed(f"status {done.returncode}: {' | '.join(said.strip().splitlines()[-_SAID:]) or 'it said nothing'}")
    return said


def wait_until(what: str, is_so: Callable[[], Any], patience_s: float = PATIENCE_S) -> Any:
    until_s = time.monotonic() + patience_s
    while not (found := is_so()):
        if time.monotonic() > until_s:
            raise Failed(f"not within {patience_s:g} s: {what}")
        time.sleep(0.01)
    return found


def expect(what: object, *, is_so: object) -> None:
    if not is_so:
        raise Failed(str(what))


def address() -> dict[str, Any]:
    """Address of the running instrument; empty if there is none."""
    with suppress(OSError, ValueError):
        return dict(json.loads(ADDRESS.read_text()))
    return {}


def complete(name: str) -> dict[str, Any]:
    facts = dict(json.loads((WORK / name / "run.json").read_text("utf-8")))
    expect(f"{name} is not complete", is_so=facts["complete"])
    return facts


@contextmanager
def program(*command: object, **options: Any) -> Iterator[psutil.Process]:
    """Run a command beside; it ends here at the latest, with all that it has started."""
    ADDRESS.unlink(missing_ok=True)  # of one that was killed
    with (WORK / "program.log").open("wb") as log:
        started = psutil.Popen([str(part) for part in command], stdout=log, stderr=log, cwd=WORK, **options)
        try:
            yield started
        finally:
            with suppress(psutil.Error):
                for each in (*started.children(recursive=True), started):
                    with suppress(psutil.Error):
                        each.kill()
            if process := address().get("process"):
                with suppress(psutil.Error):
                    psutil.Process(process).kill()
            started.wait(PATIENCE_S)


@contextmanager
def serving(bench: object, *more: str, **options: Any) -> Iterator[psutil.Process]:
    """Run `svwfs serve`; yields the instrument's process, which svwfs.exe has started."""
    with program(SCRIPTS / "svwfs.exe", "serve", "--bench", bench, *more, **options):
        try:
            yield psutil.Process(wait_until("an instrument", address)["process"])
        except Failed as error:
            said = (WORK / "program.log").read_text(errors="replace").strip().splitlines()[-1:]
            raise Failed(f"{error}; {said}") from error


# Commands


def selftest() -> str:
    return f"{svwfs('selftest').count(' ok')} checks"


def simulate() -> str:
    svwfs("simulate", "--bench", "small_demo", "--out", "simulated")
    return ", ".join(sorted(each.name for each in (WORK / "simulated").iterdir()))


def reconstruct() -> str:
    frames = [f"simulated/{name}.tif" for name in ("frame", "reference", "dark")]
    given = (frames[0], "--reference", frames[1], "--dark", frames[2])
    svwfs("reconstruct", *given, "--bench", "small_demo", "--out", "result.nc")
    found = python("import svwfs; print(svwfs.open_result('result.nc').rms.mean().item())")
    return f"mean RMS {float(found):.6f} rad"


def measure() -> str:
    svwfs("measure", "--bench", "small_demo", "--frames", 60, "--average", 4, "--out", "measured")
    complete("measured")
    return python("import svwfs; print(svwfs.open_result('measured/results.nc').sizes['frame'], 'frames')").strip()


def serve() -> str:
    with serving("small_demo"):
        said = python(CLIENT, WORK / "recorded")
        psutil.wait_procs([psutil.Process(process)] if (process := address().get("process")) else [], PATIENCE_S)
    return f"{said.strip()}, recorded {complete('recorded')['frames']['recorded']}"


def asked_to_end() -> str:
    said = python(ASKED, WORK / "asked").strip()
    return f"status {said}, recorded {complete('asked')['frames']['recorded']}"


def window() -> str:
    """The window is killed once it shows wavefronts; its instrument measures on, until a client ends it."""
    with program(SCRIPTS / "svwfs-window.exe", "--bench", "small_demo") as shown:
        process = psutil.Process(wait_until("an instrument", address)["process"])
        python(WATCHES)
        time.sleep(12)  # the window draws; layers are found after some seconds
        screenshot(FOLDER / "screen.png")
        for each in (process.parent(), shown):  # svwfs-window.exe has started the window
            with suppress(psutil.Error):
                each.kill()
        time.sleep(1.0)
        expect("the instrument ended with its window", is_so=process.is_running())
        said = python(STILL_MEASURES)
        psutil.wait_procs([process], PATIENCE_S)
    return f"screen.png; without the window {said.strip()} more frames"


def start_menu() -> str:
    """The entry is opened, as by a click; its window starts an instrument, which a client watches."""
    ADDRESS.unlink(missing_ok=True)  # of one that was killed
    entry = Path(svwfs("desktop", "--bench", "small_demo").partition("entry: ")[2].strip())
    try:
        vars(os)["startfile"](entry)  # which Windows alone has
        wait_until("an instrument", address)
        said = python(WATCHES)
    finally:
        for each in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):
                each.kill()
        svwfs("desktop", "--remove")
    expect(f"{entry} is still there", is_so=not entry.exists())
    return f"{entry.name} started a window and its instrument; a client saw {said.strip()}"


def screenshot(file: Path) -> None:
    """Write the display of Xvfb, which is a file, as a picture."""
    import numpy as np  # noqa: PLC0415 - the other lines need it not
    from PIL import Image  # noqa: PLC0415 - the same

    raw = (FOLDER / "Xvfb_screen0").read_bytes()
    header = np.frombuffer(raw, ">u4", 25)
    width, height, stride, colours = (int(header[place]) for place in (4, 5, 12, 19))
    pixels = np.frombuffer(raw, np.uint8, height * stride, int(header[0]) + 12 * colours)
    picture = pixels.reshape(height, -1, 4)[:, :width, 2::-1]
    Image.fromarray(np.ascontiguousarray(picture)).save(file)
    expect("the screen shows one colour", is_so=len(np.unique(picture.reshape(-1, 3)[::97], axis=0)) > 20)


def recover() -> str:
    with program(SCRIPTS / "svwfs.exe", "measure", "--bench", "small_demo", "--frames", 100000, "--out", "cut") as cut:
        lines = WORK / "cut" / "frames.jsonl"
        wait_until("recorded frames", lambda: lines.exists() and lines.read_bytes().count(b"\n") > 10)
        for each in (*cut.children(recursive=True), cut):
            with suppress(psutil.Error):
                each.kill()
        cut.wait(PATIENCE_S)
    noted = lines.read_bytes().count(b"\n")
    svwfs("recover", "cut")
    recorded = complete("cut")["frames"]["recorded"]
    expect(f"{noted} frames were acknowledged, {recorded} survived", is_so=recorded >= noted)
    return f"{recorded} frames, {noted} acknowledged"


def replay() -> str:
    return svwfs("replay", "measured", "--verify").strip().splitlines()[-1]


def report() -> str:
    svwfs("report", "measured", "--out", "report.pdf")
    expect("it is no PDF", is_so=(WORK / "report.pdf").read_bytes().startswith(b"%PDF"))
    return f"{(WORK / 'report.pdf').stat().st_size // 1000} kB"


def devices() -> str:
    said = svwfs("devices")
    expect(f"no DCAM camera: {said}", is_so='driver = "dcam"' in said or "C9100" in said)
    return " ".join(line.strip() for line in said.splitlines() if "dcam" in line)[:60]


def check_light() -> str:
    said = svwfs("devices", "--check", "light", "--bench", "lab.toml", "--trust-library")
    return said.strip().splitlines()[-1].strip()


def check_camera() -> str:
    said = svwfs("devices", "--check", "camera", "--bench", "lab.toml", "--trust-library")
    return said.strip().splitlines()[-1].strip()


def check_gige_camera() -> str:
    """The camera is that of Aravis for tests, in a process of its own."""
    setup = (WORK / "lab.toml").read_text().partition("[camera]")[0]
    (WORK / "gige.toml").write_text(setup + GIGE_BENCH)
    with program(sys.executable, "-c", GIGE_CAMERA):
        wait_until("a GigE camera", lambda: 'driver = "genicam"' in svwfs("devices"))
        said = svwfs("devices", "--check", "camera", "--bench", "gige.toml")
    return said.strip().splitlines()[-1].strip()


def light_off() -> str:
    said = svwfs("light-off", "--bench", "lab.toml")
    expect("the light is on", is_so=not changes()[-1][1])
    return said.strip()


def lab() -> str:
    """DCAM stand-in and serial light, with a client that records."""
    with serving("lab.toml", "--trust-library") as process:
        wait_lit()
        said = python(
            "import svwfs, sys\nwith svwfs.connect() as to:\n    to.record(sys.argv[1], frames=5)\n    to.shut_down()",
            WORK / "lab",
        )
        psutil.wait_procs([process], PATIENCE_S)
    expect("the light is on", is_so=not changes()[-1][1])
    return f"{said.strip()} recorded {complete('lab')['frames']['recorded']}"


# Ends


def changes() -> list[tuple[float, bool]]:
    """The moments when the light went on or off, as `time.time` tells."""
    lines = (FOLDER / "light.log").read_text().splitlines()
    return [(float(line.split()[0]), line.split()[1] == "True") for line in lines]


def wait_lit() -> None:
    wait_until("light", lambda: changes()[-1][1] and time.time() > changes()[-1][0] + LIT_S)


def off_after(begin_s: float, limit_s: float) -> str:
    def went_off() -> float:
        return next((time_s for time_s, is_on in changes() if time_s > begin_s and not is_on), 0.0)

    took_s = wait_until("the light is off", went_off, 20.0) - begin_s
    time.sleep(0.5)
    expect("it was lit again", is_so=not changes()[-1][1])
    expect(f"the light was off after {took_s:.2f} s, not {limit_s:g}", is_so=took_s <= limit_s)
    return f"light off after {took_s:.2f} s (at most {limit_s:g})"


def watchdog_of(process: psutil.Process) -> psutil.Process:
    (found,) = (each for each in process.children(recursive=True) if "watchdog" in " ".join(each.cmdline()))
    return found


def end_of(act: Callable[[psutil.Process], object], limit_s: float, *, is_console: bool = False) -> str:
    flags = getattr(subprocess, "CREATE_NEW_CONSOLE", 0) if is_console else 0
    with serving("lab.toml", "--trust-library", creationflags=flags) as process:
        wait_lit()
        watchdog, begin_s = watchdog_of(process), time.time()
        returned = act(process)
        said = off_after(returned if isinstance(returned, float) else begin_s, limit_s)
        with suppress(psutil.Error):
            process.kill()  # of one that is suspended
        wait_until("the watchdog has ended", lambda: not watchdog.is_running(), 20.0)
    return said


def console_closed() -> str:
    def close(process: psutil.Process) -> float:
        return float(python(CLOSE_CONSOLE, process.pid))

    return end_of(close, 0.3, is_console=True)


def instrument_killed() -> str:
    return end_of(lambda process: process.kill(), 0.3)


def watchdog_killed() -> str:
    return end_of(lambda process: watchdog_of(process).kill(), 0.6)


def instrument_suspended() -> str:
    return end_of(lambda process: process.suspend(), 1.7)


def missed_deaths() -> str:
    missed = deaths = 0
    while deaths < DEATHS:
        with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE) as parent:  # noqa: S603 - our own
            assert parent.stdout is not None
            watchdogs = [psutil.Process(int(pid)) for pid in parent.stdout.readline().split()]
            expect("no watchdogs", is_so=len(watchdogs) == _AT_ONCE)
            parent.kill()
        _, alive = psutil.wait_procs(watchdogs, 10.0)
        for each in alive:
            each.kill()
        missed, deaths = missed + len(alive), deaths + len(watchdogs)
    expect(f"{missed} of {deaths} missed", is_so=not missed)
    return f"{missed} of {deaths} missed"


LINES: dict[str, Callable[[], str]] = {
    "selftest": selftest,
    "simulate": simulate,
    "reconstruct": reconstruct,
    "measure": measure,
    "serve, with a client that records": serve,
    "live, with its window": window,
    "desktop, opened in the start menu": start_menu,
    "recover": recover,
    "replay --verify": replay,
    "report": report,
    "devices": devices,
    "devices --check camera": check_camera,
    "devices --check camera, GigE": check_gige_camera,
    "devices --check light": check_light,
    "light-off": light_off,
    "serve, DCAM and serial light": lab,
    "instrument asked to end": asked_to_end,
    "console closed": console_closed,
    "instrument killed": instrument_killed,
    "watchdog killed": watchdog_killed,
    "instrument suspended": instrument_suspended,
    "watchdog and deaths of its parent": missed_deaths,
}


def main() -> int:
    """Try each line whose name has a word of ONLY in it, or all."""
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True)
    shutil.copy(FOLDER / "lab.toml", WORK)
    chosen = re.compile(os.environ.get("ONLY", ""))
    table = list[str]()
    failures = 0
    for name, line in LINES.items():
        if chosen.search(name):
            begin_s = time.monotonic()
            try:
                result, is_good = line(), True
            except (Failed, OSError, ValueError, LookupError, psutil.Error) as error:
                result, is_good = (
                    f"{type(error).__name__}: {error}" if not isinstance(error, Failed) else str(error),
                    False,
                )
            failures += not is_good
            text = f"{name:34} {'ok    ' if is_good else 'FAILED'} {time.monotonic() - begin_s:6.1f} s  {result}"
            table.append(text)
            print(text, flush=True)  # noqa: T201 - progress
    table = ["", f"on {sys.platform}, {sys.version.split(' (')[0]}", *table, f"{failures} of {len(table)} lines fail"]
    print("\n".join(table))  # noqa: T201 - the result
    return min(failures, 1)


if __name__ == "__main__":
    sys.exit(main())

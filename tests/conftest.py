"""Fixtures shared by several test files."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Generator, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings
from support.optics import PAPER, SmallBench, checkerboard
from support.paths import SMALL_TOML
from support.posix import HIDDEN, SIGHUP

from app.acquisition.devices import simulated_bench
from app.bench.config import load_bench
from app.measurement import background_estimator
from app.measurement.background_estimator import BackgroundEstimator
from simulated_devices.clock import ManualClock

if TYPE_CHECKING:  # Qt is loaded by the tests of the window alone
    from PyQt6.QtWidgets import QApplication
    from pytestqt.qtbot import QtBot
    from support.gui_bench import FakeCamera
    from support.running import Running
    from support.window_tools import MakeWindow

    from app.acquisition.remote.server import Server
    from app.gui.shell.main_window import MainWindow

_END_S = 30.0  # for threads that are about to end, at low priority beside other tests
_LASTING = ("zarr_io", "asyncio_", "reconstruction_")  # Zarr's, and those of `worker_pool`
_OF_POSIX = {"lamp_port"}  # fixtures
_WATCHED = {"gui", "acquisition", "remote"}  # others leave threads of Dask and of process pools

pytest_plugins = ["support.driver_fixtures"]

# Each run tries the same examples, however slow the computer is; with `--hypothesis-profile=random`, each time others.
_PATIENT = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("random", _PATIENT, derandomize=False)
settings.register_profile("same", _PATIENT, derandomize=True, database=None)
settings.load_profile("same")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of this project."""
    parser.addoption("--costs", metavar="FOLDER", type=Path, help="write the processor seconds of every test there")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Search for garbage neither while all is loaded nor later in what was: tests do it after each window."""
    gc.disable()
    result = yield
    gc.collect()
    gc.freeze()
    gc.enable()
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Note what a test costs with its fixtures and its child processes, in processor seconds."""
    folder, before = item.config.getoption("--costs"), sum(os.times()[:4])
    result = yield
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / f"{os.environ.get('PYTEST_XDIST_WORKER', 'main')}.csv").open("a") as file:
            file.write(f"{sum(os.times()[:4]) - before:.2f},{item.nodeid}\n")
    return result


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests with fixtures that need POSIX, and leave out all with this mark where it is missing."""
    for item in items:
        if not _OF_POSIX.isdisjoint(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.posix)
        if os.name != "posix" and item.get_closest_marker("posix") is not None:
            item.add_marker(pytest.mark.skip(reason="needs POSIX"))


@pytest.fixture(autouse=True)
def _posix_where_marked(request: pytest.FixtureRequest) -> Iterator[None]:
    """Hide what Windows lacks from tests without the mark `posix`, which run there."""
    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("posix") is None:
            for module, names in HIDDEN.items():
                for name in names.split():
                    patch.delattr(module, name, raising=False)
        yield


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Cache rendered images for this run alone, once for all its processes; no other program meets its instruments."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    with pytest.MonkeyPatch.context() as patch:
        for name in ("XDG_CACHE_HOME", "WIN_PD_OVERRIDE_LOCAL_APPDATA"):
            patch.setenv(name, str(folder / "cache"))
        with TemporaryDirectory(prefix="svwfs", dir=gettempdir()) as meeting:  # a socket's path must be short
            patch.setenv("SVWFS_RUNTIME_DIR", meeting)
            yield


class BackgroundEstimatorHere(BackgroundEstimator):
    """A background estimator with the interface of its process."""

    process = None

    def stop(self) -> None:
        """Let what runs come to its end."""

    def close(self) -> None:
        """Release nothing."""


@pytest.fixture(autouse=True)
def _background_estimators_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search for layers in this process: another takes a second to start, and its code cannot be replaced."""
    monkeypatch.setattr(background_estimator, "BackgroundEstimatorProcess", BackgroundEstimatorHere)


@pytest.fixture(autouse=True)
def _no_leftovers(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail if a top-level widget outlives a test, or a thread one of the folders that end theirs."""
    before = set(threading.enumerate())
    yield
    windows = _left_windows()
    assert not windows, f"windows outlive the test: {windows}"
    if request.path.parent.name not in _WATCHED:
        return
    deadline_s = time.monotonic() + _END_S
    started = [each for each in threading.enumerate() if each not in before and not _lasts(each)]
    for thread in started:
        thread.join(max(0.0, deadline_s - time.monotonic()))
    threads = [thread.name for thread in started if thread.is_alive()]
    assert not threads, f"threads outlive the test: {threads}"


def _left_windows() -> list[str]:
    """Top-level widgets; those without an owner are freed first."""
    if "PyQt6.QtWidgets" not in sys.modules:  # only tests of the window load Qt
        return []
    from PyQt6.QtCore import QEvent  # noqa: PLC0415 - it is loaded
    from PyQt6.QtWidgets import QApplication  # noqa: PLC0415 - it is loaded

    if QApplication.instance() is None or not QApplication.topLevelWidgets():
        return []
    QApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)
    gc.collect()
    if QApplication.topLevelWidgets():  # a first analysis froze what was there, see `loading`
        gc.unfreeze()
        gc.collect()
        gc.freeze()
    return [f"{type(each).__name__} {each.windowTitle()}".strip() for each in QApplication.topLevelWidgets()]


def _lasts(thread: threading.Thread) -> bool:
    """True for threads that last as long as the process, and those that Python has not started and cannot join."""
    return isinstance(thread, threading._DummyThread) or thread.name.startswith(_LASTING)


@pytest.fixture
def runtime_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of its own in which instruments and their clients meet."""
    with TemporaryDirectory(prefix="svwfs", dir=gettempdir()) as made:
        monkeypatch.setenv("SVWFS_RUNTIME_DIR", made)
        yield Path(made)


@pytest.fixture
def default_signals() -> Iterator[None]:
    """Hear Ctrl-C and a hangup as in a terminal, even if the shell ignores them, as `nohup` does."""
    interrupt = signal.signal(signal.SIGINT, signal.default_int_handler)
    hangup = signal.signal(SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, interrupt)
    signal.signal(SIGHUP, hangup)


@pytest.fixture(scope="session")
def small_bench() -> SmallBench:
    """A 7 x 9 lattice, off centre and turned, on a non-square camera, with a uniform square as its source."""
    return SmallBench()


@pytest.fixture(scope="session")
def paper_bench() -> SmallBench:
    """The small bench in the paper's world, which conserves flux: a uniform square shows every displacement."""
    return SmallBench(field=PAPER)


@pytest.fixture(scope="session")
def checker_bench() -> SmallBench:
    """The small bench with a checkerboard, which shows every displacement in real light."""
    return SmallBench(source=checkerboard())


@pytest.fixture(scope="session")
def small_toml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench file of 5 x 7 lenslets that renders at once."""
    path = tmp_path_factory.mktemp("bench") / "small.toml"
    path.write_text(SMALL_TOML)
    return path


@pytest.fixture(scope="session")
def quick_toml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """That bench without the response, which takes most of a reference's preparation."""
    path = tmp_path_factory.mktemp("bench") / "quick.toml"
    path.write_text(SMALL_TOML.replace("[reconstruction]\n", "[reconstruction]\nresponse = false\n"))
    return path


@pytest.fixture
def no_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulated bench has a clock that lets each frame be measured before the next begins."""
    monkeypatch.setattr("app.acquisition.devices.simulated_bench", partial(simulated_bench, clock=ManualClock()))


@pytest.fixture(scope="session")
def qapp(qapp: QApplication) -> QApplication:
    """The one of pytest-qt, in the font that Matplotlib brings: texts are as wide on every computer."""
    from support.window_tools import use_font  # noqa: PLC0415 - only where a window is wanted

    use_font(qapp)
    return qapp


@pytest.fixture
def qtbot(qapp: QApplication, request: pytest.FixtureRequest) -> QtBot:  # noqa: ARG001 - it must be there
    """The one of pytest-qt, with more patience."""
    from support.window_tools import PatientBot  # noqa: PLC0415 - only where a window is wanted

    return PatientBot(request)


@pytest.fixture
def restored_theme(qapp: QApplication) -> Iterator[None]:
    """Restore colours, palette and style sheet after the test."""
    from app.gui.widgets.theme import _PAIRS  # noqa: PLC0415 - only where a window is wanted

    colours = [(colour, colour.name()) for colour, _, _ in _PAIRS]
    palette, style = qapp.palette(), qapp.styleSheet()
    yield
    for colour, name in colours:
        colour.setNamedColor(name)
    qapp.setPalette(palette)
    qapp.setStyleSheet(style)
    qapp.setProperty("theme", None)


@pytest.fixture
def make_window(qapp: QApplication) -> Iterator[MakeWindow]:  # noqa: ARG001 - it must be there
    """Make windows; see `window_tools.windows`."""
    from support.window_tools import windows  # noqa: PLC0415 - only where a window is wanted

    with windows() as make:
        yield make


@pytest.fixture
def live(make_window: MakeWindow, qtbot: QtBot) -> tuple[MainWindow, FakeCamera]:
    """A window with live wavefronts, its dark and reference of few frames."""
    from support.gui_bench import FakeCamera  # noqa: PLC0415 - only where a window is wanted
    from support.window_tools import wait_for_wavefront  # noqa: PLC0415 - only where a window is wanted

    camera = FakeCamera()
    window = make_window(camera, frames=6)
    window.connect_devices()
    wait_for_wavefront(qtbot, window)
    return window, camera


@pytest.fixture
def running(quick_toml: Path) -> Iterator[Running]:
    """An acquisition on the bench of `quick_toml`, to be begun."""
    from support.running import Running  # noqa: PLC0415 - only where it is wanted

    running = Running(load_bench(quick_toml))
    yield running
    running.acquisition.close()


@pytest.fixture
def fake_camera() -> FakeCamera:
    """The camera of `server`."""
    from support.gui_bench import FakeCamera  # noqa: PLC0415 - only where it is wanted

    return FakeCamera()


@pytest.fixture
def server(fake_camera: FakeCamera, runtime_folder: Path) -> Iterator[Server]:  # noqa: ARG001 - it must be there
    """An instrument that serves `fake_camera` to other programs."""
    from support.served import served  # noqa: PLC0415 - only where it is wanted

    with served(fake_camera) as running:
        yield running


@pytest.fixture
def no_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """The light may be switched on as soon as it is off."""
    monkeypatch.setattr("app.gui.shell.light_control._REST_S", 0.0)

"""Memory of a closed bench."""

from __future__ import annotations

import ctypes
import gc
import sys
import weakref
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import pytest
from PyQt6.QtCore import QPoint
from pytestqt.qtbot import QtBot
from support.gui_bench import BENCH, FakeCamera, opener
from support.served import served
from support.window_tools import MakeWindow, click, tab, wait_for_wavefront

from app.acquisition.remote.connection import reach
from app.acquisition.worker import Acquisition
from app.bench.config import load_bench
from app.gui.shell.main_window import MainWindow
from app.results.player import InstrumentFactory

COARSE = "simulation.object_samples=11", "simulation.pupil_samples=10"  # rendered sooner, of the same size


def references(window: MainWindow) -> dict[str, weakref.ref[object]]:
    """Large objects of the open bench that allow weak references."""
    acquisition, measurement = window.controller.acquisition, window.shown.measurement
    assert acquisition is not None
    assert measurement is not None
    assert measurement.wavefront is not None
    assert measurement.calibration is not None
    assert measurement.calibration.dark is not None
    found: dict[str, object] = {
        "acquisition": acquisition,
        "recorder or frames": acquisition._recorder if isinstance(acquisition, Acquisition) else acquisition.frames,
        "frame": measurement.frame.pixels,
        "views": measurement.wavefront.views,
        "reference": measurement.calibration.reference.mean,
        "dark": measurement.calibration.dark.mean,
    }
    return {name: weakref.ref(each) for name, each in found.items()}


def alive(found: dict[str, weakref.ref[object]]) -> list[str]:
    """Name what is not yet garbage."""
    gc.unfreeze()
    gc.collect()
    gc.freeze()
    return [name for name, each in found.items() if each() is not None]


@pytest.fixture(params=["in the window's process", "in its own"])
def window(
    request: pytest.FixtureRequest, make_window: MakeWindow, runtime_folder: Path, qtbot: QtBot
) -> Iterator[MainWindow]:
    """A window that shows an instrument."""
    assert runtime_folder.is_dir()
    made, is_remote = make_window(), request.param == "in its own"
    with served(FakeCamera()) if is_remote else nullcontext():
        if is_remote:
            made.open(InstrumentFactory(lambda: reach("window"), lambda _: ()))
        else:
            made.open(InstrumentFactory(lambda: Acquisition(BENCH, opener(FakeCamera()))))
        wait_for_wavefront(qtbot, made)
        yield made


@pytest.mark.slow
@pytest.mark.long
def test_closed_bench_dies_although_every_panel_has_shown_it(window: MainWindow, qtbot: QtBot) -> None:
    lenslet, layers = window.panels.lenslet, window.panels.layers
    window.panels.lenslet.inspect(4, 6)
    qtbot.waitUntil(lambda: lenslet.name.text().endswith("converged"))
    bar, at = tab(window, "Layers")
    click(qtbot, bar, QPoint(at))
    qtbot.waitUntil(lambda: bool(layers.sentence.text()))
    window.panels.wavefronts.menu.change(averaged=4)
    window.panels.wavefronts._store()
    old = references(window)
    assert len(alive(old)) == len(old)
    window.open(InstrumentFactory(lambda: Acquisition(BENCH, opener(FakeCamera()))))
    wait_for_wavefront(qtbot, window)
    qtbot.waitUntil(lambda: not alive(old))
    assert window.panels.wavefronts.menu.options.stored is None


def memory_pages(qtbot: QtBot) -> int:
    """Pages of memory that this process has after a while."""
    qtbot.wait(300)
    ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1])


def reconstructed(window: MainWindow) -> int:
    measurement = window.shown.measurement
    return 0 if measurement is None else measurement.counts.reconstructed


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and trims the memory of its C library")
def test_memory_does_not_grow_over_twenty_openings(make_window: MakeWindow, qtbot: QtBot, small_toml: Path) -> None:
    """Freed memory that the C library keeps does not count: it is half a gigabyte after twenty openings.

    A search for layers, seconds long on a busy machine, adds a hundred megabytes while it lasts: of each bench the
    least of some sizes counts.
    """
    window, sizes = make_window(), list[int]()
    for index in range(22):
        bench = load_bench("live_demo", COARSE) if index % 2 else load_bench(small_toml)
        window.open(InstrumentFactory(partial(Acquisition, bench)))
        qtbot.waitUntil(lambda: reconstructed(window) > 5)
        qtbot.waitUntil(lambda: window.controller.is_settled)
        if index in range(2, 6) or index >= 18:
            sizes.append(min(memory_pages(qtbot) for _ in range(10)))
    assert min(sizes[4:]) < 1.1 * min(sizes[:4])

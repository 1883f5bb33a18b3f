"""GenICam parts without a camera: frame numbers, hanging calls, settings, library."""

from __future__ import annotations

import ctypes
import ctypes.util
import itertools
import re
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.patience import HANG_S

from drivers.camera import SettingsInForce
from drivers.errors import BadValue, Disconnected, Unsupported, WrongState
from drivers.genicam import GenicamSettings
from drivers.genicam._connection import CallThread
from drivers.genicam._frames import FrameCount
from drivers.genicam._library import HOW_TO_INSTALL, Aravis, kinds_of_errors, load_aravis, load_library
from drivers.genicam.camera import discover
from reconstruction.annotated_settings import check


@given(first=st.integers(1, 65535), steps=st.lists(st.integers(1, 1023), max_size=200))
def test_short_frame_numbers_wrap_without_zero(first: int, steps: list[int]) -> None:
    given_in_turn = itertools.cycle(range(1, 65536))
    ids = itertools.islice(given_in_turn, first - 1, None)
    count = FrameCount()
    assert count.advance(next(ids)) == 0
    for expected, step in zip(np.cumsum(steps), steps, strict=True):
        assert count.advance(next(itertools.islice(ids, step - 1, None))) == expected


def test_loss_across_number_wrap_is_counted() -> None:
    count = FrameCount()
    assert [count.advance(frame_id) for frame_id in (65533, 65534, 2, 3)] == [0, 1, 4, 5]  # 65535 and 1 are missing


@pytest.mark.parametrize(
    ("ids", "indices"),
    [
        ((7, 7, 7, 8), (0, 1, 2, 3)),
        ((0, 0, 0), (0, 1, 2)),
        ((65534, 65535, 0, 1), (0, 1, 2, 3)),
        ((65530, 0, 1), (0, 6, 7)),
        ((500, 501, 1, 2), (0, 1, 2, 3)),  # the camera restarted
        ((70000, 70001, 1), (0, 1, 2)),
    ],
)
def test_repeated_and_restarted_frame_numbers_are_new_frames(ids: tuple[int, ...], indices: tuple[int, ...]) -> None:
    count = FrameCount()
    assert tuple(map(count.advance, ids)) == indices


def test_frame_numbers_that_begin_again_near_their_end_count_no_losses() -> None:
    count, sent_s = FrameCount(), (0.0, 0.1, 0.3, 0.4, 0.5)
    ids = (64998, 64999, 65001, 1, 2)  # one frame is lost; across a wrap, 534 more would have been in 0.1 s
    assert tuple(map(count.advance, ids, sent_s)) == (0, 1, 3, 4, 5)


def test_loss_across_number_wrap_is_counted_if_there_was_time_for_it() -> None:
    count, sent_s = FrameCount(), (0.0, 0.1, 53.6, 53.7)
    assert tuple(map(count.advance, (64999, 65000, 1, 2), sent_s)) == (0, 1, 537, 538)


def test_long_frame_numbers_may_begin_with_zero() -> None:
    count = FrameCount()
    assert [count.advance(frame_id) for frame_id in (0, 1, 65535, 65536, 2**40)] == [0, 1, 65535, 65536, 2**40]


def test_frame_has_exposure_from_its_begin() -> None:
    in_force = SettingsInForce(0.5, 1.0)
    in_force.change(10.0 + 2.0, 2.0, 1.0)
    assert (
        in_force.of_frame(11.9)[0] == 0.5
    )  # began at 11.4 or later with the old exposure; with the new one, before 10
    assert in_force.of_frame(12.1)[0] == 2.0
    in_force.change(13.0 + 0.1, 0.1, 1.0)
    assert in_force.of_frame(13.05)[0] == 2.0
    assert in_force.of_frame(13.2)[0] == 0.1


def test_short_exposure_replaces_long_one() -> None:
    in_force = SettingsInForce(0.5, 1.0)
    in_force.change(10.0 + 100.0, 100.0, 1.0)
    in_force.change(10.1 + 0.2, 0.2, 1.0)
    assert in_force.of_frame(10.2)[0] == 0.5
    assert in_force.of_frame(10.4)[0] == 0.2


def test_frame_of_a_clock_that_was_set_back_has_the_oldest_exposure_known() -> None:
    in_force = SettingsInForce(1.0, 1.0)
    in_force.change(10.0, 2.0, 1.0)
    assert in_force.of_frame(11.0)[0] == 2.0
    assert in_force.of_frame(9.0)[0] == 2.0


def test_hanging_call_is_given_up() -> None:
    calls, ending = CallThread("test"), threading.Event()
    with pytest.raises(Disconnected, match=r"did not answer for 0\.1 s"):
        calls.call_within(lambda: ending.wait(HANG_S), 0.1)
    with pytest.raises(Disconnected):
        calls.call_within(lambda: 1, 0.1)  # queued behind it
    ending.set()
    assert calls.call_within(lambda: 2, 10) == 2  # the abandoned call does no harm
    calls.end()


def test_missing_library_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", missing)
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    load_aravis.cache_clear()
    with pytest.raises(Unsupported, match=f"{re.escape(HOW_TO_INSTALL)}$"):
        discover()


@pytest.mark.parametrize("is_packaged", [True, False])
def test_functions_are_found_in_the_libraries_of_windows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *, is_packaged: bool
) -> None:
    """There Aravis exports no functions of GLib, which lies beside it in a folder of PATH or of aravis-python."""
    try:
        real = load_library()
    except Unsupported:
        pytest.skip("the extra genicam is not installed")
    folder = tmp_path / "aravis" / "bin"
    prefix = "" if is_packaged else "lib"
    exported = {
        f"{prefix}aravis-0.8-0.dll": ("arv_",),
        f"{prefix}gobject-2.0-0.dll": ("g_object_", "g_value_"),
        f"{prefix}glib-2.0-0.dll": ("g_",),
    }
    folder.mkdir(parents=True)
    for name in exported:
        (folder / name).touch()
    (folder.parent / "__init__.py").write_text("import gi")  # of PyGObject, which Windows has no wheel of
    monkeypatch.syspath_prepend(str(tmp_path))

    class Part:
        def __init__(self, path: str) -> None:
            assert Path(path).parent == folder
            self.own = exported[Path(path).name]

        def __getattr__(self, name: str) -> object:
            if not name.startswith(self.own):
                raise AttributeError(name)
            return next(getattr(part, name) for part in real if hasattr(part, name))

    def find(name: str) -> str | None:
        return str(folder / f"{name}.dll") if not is_packaged and f"{name}.dll" in exported else None

    monkeypatch.setattr(ctypes, "CDLL", Part)
    monkeypatch.setattr(ctypes.util, "find_library", find)
    monkeypatch.setattr("drivers.genicam._library.sys.platform", "win32")
    assert Aravis().call("arv_get_major_version") == 0


def test_old_library_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.genicam._library.load_library", lambda: (object(),))
    with pytest.raises(Unsupported, match=r"too old, it lacks \w+: 0\.8\.20 or later is needed"):
        Aravis()


@pytest.mark.parametrize("version", [(0, 8), (0, 9), (0, 10)])
def test_error_numbers_follow_the_version(version: tuple[int, int]) -> None:
    """Versions 0.9 and later count STREAM_ERROR between NO_STREAM_CHANNEL, 9, and NOT_CONTROLLER."""
    later = 0 if version == (0, 8) else 1
    kinds = kinds_of_errors(version)
    assert kinds[2] is kinds[10 + later] is Disconnected
    assert kinds[13 + later] is BadValue
    assert kinds[18 + later] is WrongState
    assert later == 0 or 10 not in kinds


def test_unknown_pixel_format_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^pixel_format "):
        check(GenicamSettings(pixel_format="BayerRG8"))

"""Report of a recording: numbers, pages and legibility."""

from __future__ import annotations

import io
import itertools
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure, FigureBase
from matplotlib.text import Text
from support.command_line import run
from support.pictures import assert_drawn
from support.recordings import edit_line, record, replace_pixels

from app.errors import InputError
from app.recording.reader import Recording
from app.results.comparison import residual_of
from app.results.export import export_recording
from app.results.replay import change_of
from app.results.report_pages import certainty_page, coefficients_page, comparison_page, overview_page, write_report
from app.results.report_summary import Summary, facts, summarise
from reconstruction.arrays import Floats
from reconstruction.displacement import LensletStatus

FRAMES = 5


@pytest.fixture(scope="module")
def recording(quick_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Five frames; the left part of the third is dark."""
    made = record(quick_toml, tmp_path_factory.mktemp("recording") / "run", frames=FRAMES)
    pixels = made.pixels(2).copy()
    pixels[:, :80] = 480
    replace_pixels(made, 2, pixels)
    return made


@pytest.fixture(scope="module")
def summary(recording: Recording) -> Summary:
    return summarise(recording, None, lambda *_: None)


@pytest.fixture
def mine(recording: Recording, tmp_path: Path) -> Recording:
    """A copy that a test may damage."""
    return Recording(shutil.copytree(recording.folder, tmp_path / "mine"))


def drawn(page: Figure | None) -> Figure:
    """A page after its layout."""
    assert page is not None
    page.savefig(io.BytesIO())
    return page


def certainty(summary: Summary) -> Figure:
    found = summary.statistics
    assert found is not None
    return drawn(certainty_page(summary, found))


def texts(figure: FigureBase) -> Iterator[Text]:
    """All visible text."""
    for text in figure.findobj(Text):
        if isinstance(text, Text) and text.get_visible() and text.get_text().strip():
            yield text


def said(figure: FigureBase) -> str:
    return "\n".join(text.get_text() for text in texts(figure))


def axis_titled(figure: Figure, start: str) -> Axes:
    (axis,) = (axis for axis in figure.findobj(Axes) if isinstance(axis, Axes) and axis.get_title().startswith(start))
    return axis


def maps_of(figure: Figure) -> Floats:
    """The maps of 5 x 7 lenslets, in order."""
    images = [image.get_array() for axis in figure.findobj(Axes) if isinstance(axis, Axes) for image in axis.images]
    return np.stack([np.ma.filled(image, np.nan) for image in images if image is not None and image.shape == (5, 7)])


def assert_legible(figure: Figure) -> None:
    """Check that no text overlaps another or leaves the page."""
    hidden = beyond_limits(figure)
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts(figure) if text not in hidden]
    for name, box in boxes:
        assert box.x0 >= 0, name
        assert box.y0 >= 0, name
        assert box.x1 <= figure.bbox.x1, name
        assert box.y1 <= figure.bbox.y1, name
    for (name, box), (other_name, other) in itertools.combinations(boxes, 2):
        assert not box.padded(-1).overlaps(other.padded(-1)), (name, other_name)


def beyond_limits(figure: Figure) -> list[Text]:
    """Tick labels that are not drawn because they lie beyond the limits of their axis."""
    labels = [
        (label, label.get_position()[at], limits)
        for axis in figure.findobj(Axes)
        if isinstance(axis, Axes)
        for at, limits, of_axis in (
            (0, sorted(axis.get_xlim()), axis.get_xticklabels(which="both")),
            (1, sorted(axis.get_ylim()), axis.get_yticklabels(which="both")),
        )
        for label in of_axis
    ]
    return [label for label, position, (low, high) in labels if not low <= position <= high]


@pytest.mark.slow
@pytest.mark.long
def test_statistics_equal_those_of_the_results(recording: Recording, summary: Summary, tmp_path: Path) -> None:
    export_recording(recording.folder, "netcdf", tmp_path / "r.nc")
    found = summary.statistics
    assert found is not None
    with xr.open_dataset(tmp_path / "r.nc") as results:
        wavefront, sigma = results["wavefront"].to_numpy(), results["wavefront_sigma"].to_numpy()
        outcome = results["outcome"].to_numpy()
    np.testing.assert_allclose(found.mean, np.nanmean(wavefront, axis=0))
    np.testing.assert_allclose(found.sigma, np.sqrt(np.nanmean(sigma**2, axis=(0, 1, 2))))
    np.testing.assert_allclose(found.rms_sigma_rad, np.sqrt(np.nanmean(sigma**2, axis=(1, 2, 3, 4))))
    np.testing.assert_array_equal(found.lost, np.mean(outcome != 0, axis=0))
    assert 0 < np.count_nonzero(found.lost) < found.lost.size
    assert set(found.reason[found.lost > 0].tolist()) == {LensletStatus.DARK}
    live = [recording.line(index).rms_rad for index in (0, 1, 3, 4)]
    np.testing.assert_allclose(found.rms_rad[[0, 1, 3, 4]], np.array(live, float))


@pytest.mark.slow
def test_error_bar_covers_the_scatter_of_the_rms(small_toml: Path, tmp_path: Path) -> None:
    """The bar is an upper bound for the scatter of the RMS (Cauchy-Schwarz), here over 30 frames of one sample.

    Where flux is conserved the uniform square shows all displacements, so that the bar is that of the noise.
    """
    recorded = record(small_toml, tmp_path / "run", "field.neglect_propagation=true", frames=30)
    found = summarise(recorded, None, lambda *_: None).statistics
    assert found is not None
    assert 0 < found.rms_rad.std() < found.rms_sigma_rad.mean() < 0.05 * found.rms_rad.mean()


def test_facts_are_those_of_the_recording(mine: Recording) -> None:
    edit_line(mine, 1, lost=3)
    edit_line(mine, 4, exposure_s=0.04, light_current_a=0.5)
    edit_line(mine, 0, light_current_a=0.25)
    path = mine.folder / "run.json"
    devices = {
        "camera": {"name": "C9100", "amplifier": "em", "readout_speed": 2, "sensor_temperature": -65.0},
        "light": {"name": "a lamp"},
        "stage": {"mask": "stars"},
    }
    facts_of_run = {**json.loads(path.read_text()), "devices": devices}
    path.write_text(json.dumps({**facts_of_run, "ended_early": "the disk is full"}))
    found = dict(facts(summarise(Recording(mine.folder), None, lambda *_: None)))
    assert found["recorded"].endswith("by svwfs measure; ended early: the disk is full")
    assert found["frames"].startswith("5 recorded of 5 acquired; 3 lost by the camera; 5 of 5")
    assert found["camera"] == "C9100, 240 x 172 pixels of 16 µm, sensor_temperature -65.0"
    assert found["exposure"] == "20 ... 40 ms, em amplifier, readout speed 2, em gain 8"
    assert found["light"] == "a lamp, 250 ... 500 mA"
    assert found["mask"] == "stars"
    assert found["dark"] == found["reference"] == "mean of 4 frames of 20 ms, em gain 8"
    assert "counts per electron" in found["noise"]
    assert found["lattice"] == "7 x 5 lenslets, pitch 31.2500 px, centre (121.30, 84.60) px, turned by +3.00 mrad"
    assert found["method"] == "gauss_newton, warp quadratic, modal, legendre, 15 pupil modes"
    assert found["software"].startswith("svwfs ")


def test_first_page_shows_mean_wavefronts(summary: Summary) -> None:
    figure = drawn(overview_page(summary))
    assert summary.statistics is not None
    np.testing.assert_array_equal(maps_of(figure), summary.statistics.mean.reshape(9, 5, 7))
    mean = summary.statistics.mean[2, 1]
    assert f"(+0.00, +0.50) mm\n{np.std(mean):.3f} / {np.ptp(mean):.2f}" in said(figure)
    limits = {axis.images[0].get_clim() for axis in figure.findobj(Axes) if isinstance(axis, Axes) and axis.images}
    assert limits == {(-np.abs(summary.statistics.mean).max(), np.abs(summary.statistics.mean).max())}


@pytest.mark.slow
def test_second_page_shows_error_bars_and_lost_lenslets(summary: Summary, mine: Recording) -> None:
    assert summary.statistics is not None
    figure = certainty(summary)
    trend = axis_titled(figure, "RMS of the wavefront")
    (bars,) = (each for each in trend.containers if isinstance(each, ErrorbarContainer))
    ends = np.array(bars.lines[2][0].get_segments())  # (frame, end, xy)
    np.testing.assert_allclose(np.diff(ends[:, :, 1])[:, 0], 2 * summary.statistics.rms_sigma_rad)
    times_s = [line.host_time_s - summary.lines[0].host_time_s for line in summary.lines]
    np.testing.assert_allclose(ends[:, 0, 0], times_s)
    lost = int((summary.statistics.lost > 0).sum())
    assert axis_titled(figure, f"{lost} of 35 lenslets lost, 0 of them always").get_legend() is not None
    assert f"no light: {lost}" in said(figure)
    assert "frames lost" not in said(figure)
    edit_line(mine, 1, lost=3)
    edit_line(mine, 3, problem="skipped", rms_rad=None)
    other = summarise(Recording(mine.folder), None, lambda *_: None)
    assert other.statistics is not None
    assert len(other.statistics.frames) == FRAMES  # skipped only live
    words = said(certainty(other))
    assert "frames lost" in words
    assert "no live wavefront" in words


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    "settings",
    [
        (),
        ("field.view_rows=9", "field.view_columns=9", "field.view_spacing_m=0.14e-3"),
        ("reconstruction.method=zonal", "field.view_rows=2", "field.view_columns=5", "field.view_spacing_m=0.2e-3"),
    ],
)
def test_text_on_every_page_is_legible(recording: Recording, settings: tuple[str, ...]) -> None:
    change = change_of(None, settings)
    summary = summarise(recording, ":2", lambda *_: None, change=change)
    problems = summary.problems.copy()
    problems["a sentence that is so long that it has to be broken: " + 20 * "words and more words, "] = 3
    summary = replace(summary, problems=problems)
    assert summary.statistics is not None
    assert_legible(drawn(overview_page(summary)))
    assert_legible(certainty(summary))


def test_third_page_names_the_frame_that_it_draws(mine: Recording) -> None:
    for index in (0, 1):
        replace_pixels(mine, index, np.full_like(mine.pixels(0), 500))
    summary = summarise(mine, None, lambda *_: None)
    alone = summarise(mine, "2:3", lambda *_: None).statistics
    found = summary.statistics
    assert found is not None
    assert alone is not None
    np.testing.assert_array_equal(found.wavefront.views, alone.wavefront.views)
    page = drawn(coefficients_page(summary, found))
    assert "of frame 2 over the field" in said(page)


def test_many_frames_are_sampled(recording: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.results.report_summary._SAMPLED_FRAMES", 2)
    summary = summarise(recording, None, lambda *_: None)
    assert summary.statistics is not None
    assert summary.statistics.frames.tolist() == [0, 3]
    assert (len(summary.lines), summary.sampled_frames) == (FRAMES, "2 of 5 frames")


@pytest.mark.slow
@pytest.mark.long
def test_report_without_wavefronts_says_why(mine: Recording, tmp_path: Path) -> None:
    for index in range(FRAMES):
        replace_pixels(mine, index, np.full_like(mine.pixels(0), 500))
    summary = write_report(mine.folder, tmp_path / "r.pdf")
    assert summary.statistics is None
    figure = drawn(overview_page(summary))
    assert "no frame has a wavefront" in said(figure)
    assert "5 of them: no lenslet of the frame could be matched" in said(figure)
    assert_legible(figure)
    with pytest.raises(InputError, match="has no frame with a wavefront"):
        residual_of(mine.folder, mine.folder)


@pytest.mark.slow
@pytest.mark.long
def test_unfinished_and_single_frame_recordings_are_reported(mine: Recording, tmp_path: Path) -> None:
    path = mine.folder / "run.json"
    whole = json.loads(path.read_text())
    short = {key: whole[key] for key in ("format", "bench", "complete")} | {"complete": False}
    path.write_text(json.dumps(short))
    edit_line(mine, 4, calibration=None, start=None, problem="no reference yet", rms_rad=None)
    summary = write_report(mine.folder, tmp_path / "r.png", frames="3:4")
    found = dict(facts(summary))
    assert "not finished" in found["recorded"]
    assert found["frames"].startswith("3 ... 3 of 5 recorded; 0 lost")
    assert_drawn(tmp_path / "r.png")
    summary = write_report(mine.folder, tmp_path / "s.pdf", frames="4:")
    assert dict(facts(summary))["reference"] == "none: these frames have no calibration"


@pytest.mark.slow
def test_residual_is_the_difference(mine: Recording, tmp_path: Path) -> None:
    """A plane of slope s on 7 x 5 lenslets has the RMS s sqrt((7^2 - 1) / 12); piston does not count."""
    plane, results = 0.3 * np.arange(7.0) + 5.0, tmp_path / "r.nc"
    export_recording(mine.folder, "netcdf", results, ":2")
    with xr.open_dataset(results) as found:
        found.assign(wavefront=found["wavefront"] - plane).to_netcdf(tmp_path / "plane.nc")
        found.assign(wavefront=found["wavefront"] * np.nan).to_netcdf(tmp_path / "unknown.nc")
    residual = residual_of(mine.folder, tmp_path / "plane.nc", frames=":2")
    np.testing.assert_allclose(residual.rms_rad, 0.3 * np.sqrt((7**2 - 1) / 12))
    np.testing.assert_allclose(residual.views, np.broadcast_to(plane - plane.mean(), residual.views.shape), atol=1e-12)
    assert residual.sentence == "RMS of the difference at the views: least 0.600, most 0.600, mean 0.600 rad"
    np.testing.assert_allclose(residual_of(results, results).views, 0, atol=1e-12)
    maps = maps_of(drawn(comparison_page(residual)))
    np.testing.assert_array_equal(
        maps.reshape(3, *residual.views.shape), [residual.mean, residual.other_mean, residual.views]
    )
    assert_legible(drawn(comparison_page(replace(residual, name="$\\nothing$ ^_ " + 60 * "long "))))
    coarse = change_of(None, ("field.view_rows=1", "field.view_columns=1"))
    with pytest.raises(InputError, match="other views or lenslets"):
        residual_of(mine.folder, results, frames=":1", change=coarse)
    with pytest.raises(InputError, match="has no lenslet in common"):
        residual_of(results, tmp_path / "unknown.nc")


@pytest.mark.slow
@pytest.mark.long
def test_command_compares_with_another_method(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], recording: Recording, tmp_path: Path
) -> None:
    words = ("--set", "registration.warp=translation", "--frames", ":2", "--plot", tmp_path / "r.pdf")
    assert run(monkeypatch, "compare", recording.folder, recording.folder, *words) == 0
    assert (tmp_path / "r.pdf").read_bytes().count(b"/Type /Page ") == 1
    shown = capsys.readouterr().out
    assert "run minus run" in shown
    least, most, mean = (float(number) for number in re.findall(r"\d+\.\d{3}", shown)[-3:])
    assert 0 < least < mean < most  # a single shift per lenslet does not vary over the field
    changed = change_of(None, ("registration.warp=translation",))
    methods = [summarise(recording, ":1", lambda *_: None, change=change) for change in (None, changed)]
    assert [dict(facts(each))["method"].split(", ")[1] for each in methods] == ["warp quadratic", "warp translation"]

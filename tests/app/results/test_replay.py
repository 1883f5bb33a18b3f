"""Replay of a recording: compared with what was recorded, or with another bench."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.command_line import run
from support.recordings import edit_line, record, remove_coefficients, replace_pixels, replace_values
from support.records import frame_file

from app.bench.config import load_bench, write_bench
from app.bench.imaging_model import lenslet_model
from app.errors import InputError, RunError
from app.evaluation.frames import NoiseFreeFrames, exposure_of, with_screen
from app.measurement.estimator import Estimator
from app.measurement.measurement import SKIPPED, Measurement
from app.recording.frame_lines import assumed_sample
from app.recording.reader import Recording
from app.recording.reprocess import reprocess
from app.recording.writer import Record, RecordingWriter
from app.results import dataset
from app.results.replay import START_TOLERANCE_SIGMA, TOLERANCE_SIGMA, Replay, change_of, replay
from drivers.interface import Frame
from reconstruction.displacement import Displacement
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import KnownNoise
from reconstruction.frame.pixels import KnownCamera
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.reconstructor import Reconstructor
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.settings import ReconstructionSettings
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import mean_rms, rms
from simulated_devices.detector import Detector

FRAMES = 6


LAYERS = ("reconstruction.sample=layers", "reconstruction.pupil_modes=automatic")


# The others take seconds to record, and one or two to replay.
SLOWLY = [pytest.param(name, marks=pytest.mark.slow) for name in ("refined", "layered", "layered-refined")]


@pytest.fixture(scope="module", params=["plain", *SLOWLY])
def recording(request: pytest.FixtureRequest, small_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("recording") / request.param
    refine = f"reconstruction.refine={str('refined' in request.param).lower()}"
    layers = LAYERS if "layered" in request.param else ()
    return record(small_toml, folder, refine, *layers, frames=FRAMES)


@pytest.fixture(scope="module")
def plain(quick_toml: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return record(quick_toml, tmp_path_factory.mktemp("recording") / "plain", frames=8)


def test_frame_is_judged_beside_the_one_before(plain: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    before: list[int | None] = []
    measure = Estimator.measure

    def noted(estimator: Estimator, frame: Frame, *given: Any, previous: Frame | None, **more: Any) -> Measurement:
        before.append(None if previous is None else previous.index - plain.line(0).camera_index)
        return measure(estimator, frame, *given, previous=previous, **more)

    monkeypatch.setattr(Estimator, "measure", noted)
    assert len(list(reprocess(plain, [1, 2, 4]))) == 3
    assert before == [plain.line(at).camera_index - plain.line(0).camera_index for at in (0, 1)] + [None]


@pytest.fixture
def mine(plain: Recording, tmp_path: Path) -> Recording:
    """A copy that a test may damage."""
    return Recording(shutil.copytree(plain.folder, tmp_path / "mine"))


def test_frame_is_registered_as_behind_the_recorded_kind_of_sample(mine: Recording) -> None:
    assert [mine.line(index).absorbs for index in (1, 2)] == [False, False]
    edit_line(mine, 2, absorbs=True)
    clear, absorbing = reprocess(Recording(mine.folder), [1, 2])
    assert clear.registered is not None
    assert absorbing.registered is not None
    assert (clear.registered.absorbs, absorbing.registered.absorbs) == (False, True)


def test_frame_after_one_without_light_starts_from_the_one_before(
    mine: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_pixels(mine, 1, np.full_like(mine.pixels(1), 500))
    starts, measure = list[Displacement | None](), Estimator.measure

    def noted(estimator: Estimator, *given: Any, start: Displacement | None, **more: Any) -> Measurement:
        starts.append(start)
        return measure(estimator, *given, start=start, **more)

    monkeypatch.setattr(Estimator, "measure", noted)
    first, dark, _ = reprocess(mine, [0, 1, 2], change_of(None, ("registration.warp=affine",)))
    assert first.registered is not None
    assert dark.registered is None
    assert starts == [None, first.registered, first.registered]


@pytest.mark.slow
@pytest.mark.long
def test_frames_of_another_sample_have_their_own_layers(
    small_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But those that were tested live are reconstructed as recorded."""
    mine, bench = record(small_toml, tmp_path / "run", *LAYERS, frames=4), load_bench(small_toml, LAYERS)
    other, camera = NoiseFreeFrames(with_screen(bench, distance_m=0.02)).frame(), bench.camera_model
    for index in (2, 3):
        photons = other.photons * np.float32(camera.exposure_s)
        replace_pixels(mine, index, Detector(camera, seed=2).counts(photons, exposure_of(camera, index)))
    edit_line(mine, 2, problem=SKIPPED)
    mine = Recording(mine.folder)
    found = list[AssumedSample]()
    search = Reconstructor.find_sample

    def find(reconstructor: Reconstructor, displacement: Displacement) -> AssumedSample:
        found.append(search(reconstructor, displacement))
        return found[-1]

    monkeypatch.setattr(Reconstructor, "find_sample", find)
    recorded = [assumed_sample(mine.line(index).sample).ratios for index in range(4)]
    as_recorded = [made.wavefront.sample.ratios for made in reprocess(mine) if made.wavefront]
    assert as_recorded == [*recorded[:2], found[0].ratios, recorded[3]]
    assert found[0].ratios == pytest.approx((-0.1,), abs=0.05)
    found.clear()
    changed = reprocess(mine, None, change_of(None, ("reconstruction.refine=true",)))
    assert [made.assumed.sample for made in changed] == [found[0], found[0], found[1], found[1]]
    assert found[1].ratios == pytest.approx((-0.1,), abs=0.05)


def replayed(folder: Path, *settings: str, **options: Any) -> Replay:
    given: dict[str, Any] = {"frames": None, "out": None, "must_match": False, "progress": lambda *_: None}
    return replay(folder, change_of(None, settings), **{**given, **options})


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("frames", [":", "4:"])
def test_replay_is_as_recorded(recording: Recording, tmp_path: Path, frames: str) -> None:
    """Also from the middle, where the starting point comes from the recording."""
    is_refined = "refined" in recording.folder.name
    assert (recording.line(5).bias is not None) == is_refined
    sample = recording.line(5).sample
    assert sample is not None
    assert bool(sample.ratios) == ("layered" in recording.folder.name)
    made = replayed(recording.folder, must_match=True, frames=frames, out=tmp_path / "r.nc")
    assert made.verification is not None
    first = int(frames.partition(":")[0] or 0)
    assert (made.verification.frames, made.verification.different) == (FRAMES - first, 0)
    if first:
        assert max(made.verification.largest.values())[0] < TOLERANCE_SIGMA
    with xr.open_dataset(tmp_path / "r.nc") as again:
        np.testing.assert_array_equal(again["recording_index"], range(first, FRAMES))
        for at, index in enumerate(range(first, FRAMES)):
            apart = np.abs(again["coefficients"][at] - np.asarray(recording.coefficients(index)))
            limit_sigma = TOLERANCE_SIGMA if index else START_TOLERANCE_SIGMA
            assert np.all(apart <= limit_sigma * again["coefficients_sigma"][at])
            assert again["frame_index"][at] == recording.line(index).camera_index
            assert again["time"][at] == recording.line(index).camera_time_s
        assert bool(np.isfinite(again["bias_age"]).all()) == is_refined
        assert again.attrs["recording"] == recording.folder.name


def test_command_reports_the_verification(
    plain: Recording, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "replay", plain.folder, "--verify") == 0
    said = capsys.readouterr().out
    assert "8 frames as recorded: " in said
    assert said.count("8 frames") == 1


@pytest.mark.parametrize("threads", [1, 5])
def test_replay_is_independent_of_threads(recording: Recording, threads: int) -> None:
    compared = replayed(recording.folder, f"registration.threads={threads}").comparison
    assert compared is not None
    assert compared.frames == FRAMES
    assert compared.means_rad[2].max() < 1e-6


def test_changed_pixels_are_detected(
    mine: Recording, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Later frames keep their recorded starting points."""
    pixels = mine.pixels(3).copy()
    pixels[::2] += 9
    replace_pixels(mine, 3, pixels)
    assert run(monkeypatch, "replay", mine.folder, "--verify") == 1
    said = capsys.readouterr().err
    assert re.search(r"1 of 8 frames differ from what was recorded; frame 3: by \S+ sigma; largest", said)
    assert re.search(r"largest difference \S+ sigma, in frame 3.* \(both by svwfs", said)
    assert run(monkeypatch, "replay", mine.folder) == 0  # without --verify it is only reported
    assert "warning: 1 of 8 frames differ" in capsys.readouterr().out


@pytest.mark.parametrize(("part", "is_different"), [(0.9, False), (1.1, True)])
@pytest.mark.parametrize("name", ["displacement", "coefficients", "rms_rad"])
def test_tolerance_is_a_thousandth_of_sigma(mine: Recording, name: str, part: float, is_different: bool) -> None:
    (made,) = reprocess(mine, [5])
    assert made.wavefront is not None
    assert made.registered is not None
    solution = made.wavefront.solution
    assert isinstance(solution, ModalSolution)
    if name == "rms_rad":
        sigma_rad = np.sqrt(np.nanmean(made.wavefront.sigma() ** 2))
        edit_line(mine, 5, rms_rad=mean_rms(made.wavefront.views) + part * 1e-3 * sigma_rad)
    else:
        values = (made.registered if name == "displacement" else solution).coefficients.copy()
        sigma = np.sqrt(made.registered.variance) if name == "displacement" else solution.coefficients_sigma
        at = np.unravel_index(np.nanargmax(sigma), sigma.shape)
        values[at] += part * 1e-3 * sigma[at]
        replace_values(mine, 5, f"results/0/{name}", values)
    verification = replayed(mine.folder, frames="5:6").verification
    assert verification is not None
    assert max(verification.largest.values())[0] == pytest.approx(part * 1e-3, rel=0.01)
    assert verification.different == is_different


def test_number_that_the_solution_fixes_is_compared_with_the_largest_sigma(mine: Recording) -> None:
    values = np.array(mine.coefficients(5))
    values[0, 0] += 1e-12  # the piston, whose sigma is 0
    replace_values(mine, 5, "results/0/coefficients", values)
    verification = replayed(mine.folder, must_match=True, frames="5:6").verification
    assert verification is not None
    assert max(verification.largest.values())[0] < TOLERANCE_SIGMA


def test_first_frame_is_told_apart(mine: Recording) -> None:
    edit_line(mine, 0, rms_rad=(mine.line(0).rms_rad or 0.0) + 1e-4)
    verification = replayed(mine.folder, must_match=True).verification
    assert verification is not None
    assert re.search(r"and \S+ sigma in frame 0, whose start was not recorded", verification.sentence)


def test_other_software_version_is_named(mine: Recording) -> None:
    path = mine.folder / "run.json"
    fields = json.loads(path.read_text())
    fields["versions"]["svwfs"] = "0.0.7"
    path.write_text(json.dumps(fields))
    edit_line(mine, 5, rms_rad=1.0)
    with pytest.raises(RunError, match=r"frame 5: by .* sigma; .* \(recorded by svwfs 0.0.7, replayed by"):
        replayed(mine.folder, must_match=True)


DAMAGES: dict[str, tuple[Callable[[Recording], object], str]] = {
    "a result is missing": (lambda mine: remove_coefficients(mine, 6), "frame 6: coefficients are damaged or missing"),
    "a result is cut short": (
        lambda mine: frame_file(mine.folder, 7, "results/0/displacement").write_bytes(b"half"),
        "frame 7: displacements are damaged or missing",
    ),
    "a problem is invented": (
        lambda mine: edit_line(mine, 2, problem="too dark"),
        'frame 2: the problem was "too dark" and is ""',
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_kind_of_difference_is_named(mine: Recording, name: str) -> None:
    damage, sentence = DAMAGES[name]
    damage(mine)
    with pytest.raises(RunError, match=f"1 of 8 frames differ .*{re.escape(sentence)}"):
        replayed(mine.folder, must_match=True)


@pytest.mark.slow
@pytest.mark.long
def test_other_method_is_compared(recording: Recording, tmp_path: Path) -> None:
    """Against separate reconstructors; with the same registration, starting points and biases stay."""
    other = "reconstruction.method=zonal", "reconstruction.sample=automatic"  # "layers" rules it out
    made = replayed(recording.folder, *other, out=tmp_path / "r.nc")
    kept = recording.calibration(0)
    settings: dict[str, Any] = {
        "sensor": kept.bench.sensor,
        "lattice": kept.lattice,
        "field": kept.bench.field,
        "registration": kept.bench.registration,
        "camera": KnownCamera(
            dark=kept.dark.mean if kept.dark else None,
            full_scale=kept.full_scale,
            noise=KnownNoise(kept.reconstructor().noise, kept.reference.frames),
        ),
        "lenslet_model": partial(lenslet_model, kept.bench),
    }
    modal, zonal = (
        Reconstructor(kept.reference.mean, reconstruction=reconstruction, **settings)
        for reconstruction in (kept.bench.reconstruction, ReconstructionSettings(method="zonal"))
    )
    then, now, apart = [], [], []
    with one_blas_thread():
        for index in range(FRAMES):
            line = recording.line(index)
            bias = None if line.bias is None else recording.bias(line.bias)
            registered = modal.register(recording.pixels(index))
            sample = FREE if line.sample is None else assumed_sample(line.sample)
            views = modal.solve(registered, bias=bias, sample=sample).views, zonal.solve(registered, bias=bias).views
            then.append(rms(views[0]))
            now.append(rms(views[1]))
            apart.append(rms(views[1] - views[0]))
    compared = made.comparison
    assert compared is not None
    assert (made.verification, made.unrefined) == (None, 0)
    np.testing.assert_allclose(compared.means_rad[0], np.mean(then, axis=0), rtol=1e-3)
    np.testing.assert_allclose(compared.means_rad[1], np.mean(now, axis=0), rtol=1e-3)
    np.testing.assert_allclose(compared.means_rad[2], np.mean(apart, axis=0), rtol=1e-2)
    with xr.open_dataset(tmp_path / "r.nc") as written:
        np.testing.assert_allclose(written["difference_rms"].mean("frame"), compared.means_rad[2])
        np.testing.assert_allclose(written["recorded_rms"].mean("frame"), compared.means_rad[0])
        np.testing.assert_allclose(written["rms"].mean("frame"), compared.means_rad[1])
        assert "coefficients" not in written
        assert 'method = "zonal"' in written.attrs["bench"]


def test_other_registration_drops_the_refinement_with_notice(
    recording: Recording, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "replay", recording.folder, "--set", "registration.warp=affine") == 0
    said = capsys.readouterr().out
    assert (f"{FRAMES} frames refined when recorded, but not with this bench" in said) == (
        "refined" in recording.folder.name
    )
    assert f"mean of {FRAMES} frames" in said
    assert "as recorded:" not in said


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("setting", "rows"), [("field.view_rows=2", (2, 5)), ("sensor.lenslet_rows=3", (3, 3))])
def test_other_views_or_lenslets_are_not_compared(
    plain: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    setting: str,
    rows: tuple[int, int],
) -> None:
    options = ("--set", setting, "--set", "reconstruction.pupil_modes=6", "--out", tmp_path / "r.nc", "--frames", ":2")
    assert run(monkeypatch, "replay", plain.folder, *options) == 0
    assert "nothing to compare" in capsys.readouterr().out
    with xr.open_dataset(tmp_path / "r.nc") as written:
        assert (written.sizes["view_row"], written.sizes["lenslet_row"]) == rows


DARK, PASSED, UNCALIBRATED, CHANGED = 3, 2, 0, 6  # special frames of the recording below


@pytest.mark.slow
@pytest.mark.long
def test_bias_of_another_chosen_warp_is_not_subtracted(small_toml: Path, tmp_path: Path) -> None:
    settings = ("registration.warp=automatic", "reconstruction.refine=true")
    recording = record(small_toml, tmp_path / "run", *settings, frames=2)
    assert recording.line(0).bias is not None
    made = replayed(recording.folder, "reconstruction.method=zonal")  # with an affine warp
    assert (made.reconstructed, made.unrefined) == (2, 2)


@pytest.fixture(scope="module")
def eventful(plain: Recording, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Eight frames: one without calibration, one skipped, one too dark, and new settings from the seventh on."""
    folder = tmp_path_factory.mktemp("recording") / "eventful"
    kept = plain.calibration(0)
    fewer = replace(kept.bench, reconstruction=ReconstructionSettings(pupil_modes=10))
    calibrations = [kept] * CHANGED + [replace(kept, bench=fewer)] * 2
    writer = RecordingWriter(folder, {"command": "live", "bench": write_bench(kept.bench)})
    before: Displacement | None = None
    with one_blas_thread():
        for index, calibration in enumerate(calibrations):
            frame = plain.frame(index)
            if index == DARK:
                frame = replace(frame, pixels=np.full_like(frame.pixels, 500))
            start = None if index == CHANGED else before
            made = Measurement(frame, None, "", calibration=calibration)
            if index == UNCALIBRATED:
                made = replace(made, calibration=None, problem="no reference yet")
            elif index == PASSED:
                made = replace(made, problem=SKIPPED)
            else:
                try:
                    reconstructor = calibration.reconstructor()
                    registered = reconstructor.register(frame.pixels, start=start)
                    wavefront = reconstructor.solve(registered)
                    made = replace(made, wavefront=wavefront, registered=registered)
                    before = registered
                except ReconstructionError as error:
                    made = replace(made, problem=str(error))
            writer.write(Record.of(made))
    writer.finish("", acquired=8, facts={})
    writer.close()
    return Recording(folder)


@pytest.mark.slow
@pytest.mark.long
def test_calibration_changes_are_replayed(eventful: Recording) -> None:
    assert "is the light on?" in eventful.line(DARK).problem
    made = replayed(eventful.folder, must_match=True)
    assert made.verification is not None
    assert (made.verification.frames, made.verification.different) == (6, 0)  # the others have no recorded results
    assert re.fullmatch(r"6 frames as recorded: .*; 2 more were not reconstructed then", made.verification.sentence)
    assert (made.frames, made.reconstructed, made.problem) == (8, 6, "no reference yet")


def test_replay_starts_as_recorded_after_skipped_frames(quick_toml: Path, tmp_path: Path) -> None:
    recording = record(quick_toml, tmp_path / "run", frames=5, before=1, passed_over=[0, 2, 3])
    assert [recording.start(index) is None for index in range(5)] == [True, True, False, False, False]
    verification = replayed(recording.folder, must_match=True).verification
    assert verification is not None
    assert (verification.frames, verification.different) == (2, 0)
    # the first started from a frame before the recording
    assert 0 < max(verification.largest.values())[0] < START_TOLERANCE_SIGMA
    verification = replayed(recording.folder, must_match=True, frames="2:").verification
    assert verification is not None
    assert max(verification.largest.values())[0] < TOLERANCE_SIGMA


@pytest.mark.parametrize("frame", [UNCALIBRATED, PASSED])
def test_verification_without_results_fails(eventful: Recording, frame: int) -> None:
    with pytest.raises(RunError, match="there is nothing to compare"):
        replayed(eventful.folder, must_match=True, frames=f"{frame}:{frame + 1}")


@pytest.mark.slow
def test_skipped_frame_is_reconstructed(eventful: Recording, tmp_path: Path) -> None:
    replayed(eventful.folder, frames=f":{CHANGED}", out=tmp_path / "r.nc")
    kept = eventful.calibration(0).reconstructor()(eventful.pixels(PASSED))
    with xr.open_dataset(tmp_path / "r.nc") as written:
        assert written["recording_index"].to_numpy().tolist() == [1, PASSED, 4, 5]
        np.testing.assert_allclose(written["rms"][1], rms(kept.views), rtol=1e-3)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("at_once", [32, 4])  # in one piece, or after the first is written
def test_changed_settings_do_not_fit_one_file(
    eventful: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    monkeypatch.setattr(dataset, "PIECE", at_once)
    with pytest.raises(
        InputError, match="the settings changed between these frames: select frames with equal settings"
    ):
        replayed(eventful.folder, out=tmp_path / "r.nc")
    assert not list(tmp_path.iterdir())
    replayed(eventful.folder, out=tmp_path / "r.nc", frames=f"{CHANGED}:")
    with xr.open_dataset(tmp_path / "r.nc") as written:
        assert written.sizes["pupil_mode"] == 10


@pytest.mark.slow
@pytest.mark.long
def test_pieces_equal_the_whole(plain: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replayed(plain.folder, out=tmp_path / "one.nc", frames=":5")
    monkeypatch.setattr(dataset, "PIECE", 2)
    replayed(plain.folder, out=tmp_path / "two.nc", frames=":5")
    with xr.open_dataset(tmp_path / "one.nc") as one, xr.open_dataset(tmp_path / "two.nc") as two:
        xr.testing.assert_identical(one, two)

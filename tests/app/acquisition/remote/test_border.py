"""Frames between processes: what every method, basis and solver makes of a frame arrives at a client."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.gui_bench import BENCH, make_frame
from support.optics import FIELD, SmallBench, phase_only
from support.patience import HANG_S, wait_until

from app.acquisition.remote.frames import RemoteFrames
from app.acquisition.serialization import encoded, unpacked
from app.acquisition.streams.publisher import Publisher
from app.bench.config import Bench
from app.measurement.calibration import Calibration
from app.measurement.measurement import Assumptions, FrameTotals, Gap, LightState, Measurement, RefinementState
from app.progress import run_in_thread
from app.results.shown_wavefront import with_views
from reconstruction.field_coefficients import ModalFit, fit_coefficients
from reconstruction.layers.layered_wavefront import FREE, AssumedSample
from reconstruction.quality.slope_residual import slope_residual
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.reconstructor import Reconstructor
from reconstruction.settings import ReconstructionSettings, RegistrationSettings
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront
from simulated_devices.optics.source import stars
from simulated_devices.settings import Source

ONE_LAYER = AssumedSample((-0.975,), np.array([[1e-4]]))
TWO_LAYERS = AssumedSample((-0.975, 0.2), np.array([[1e-4, 2e-5], [2e-5, 4e-4]]))
QUADRATIC = RegistrationSettings(warp="quadratic")


@dataclass(frozen=True)
class Case:
    """How a frame is reconstructed."""

    registration: RegistrationSettings
    sample: AssumedSample = FREE
    has_bias: bool = False
    has_stars: bool = False
    is_circle: bool = False
    reconstruction: ReconstructionSettings = ReconstructionSettings(response=False)


def solving(**settings: Any) -> ReconstructionSettings:
    return ReconstructionSettings(response=False, **settings)


CASES = {
    "free": Case(QUADRATIC),
    "one layer": Case(QUADRATIC, ONE_LAYER),
    "two layers": Case(RegistrationSettings(warp="cubic"), TWO_LAYERS),
    "bias": Case(QUADRATIC, ONE_LAYER, has_bias=True),
    "affine": Case(RegistrationSettings(warp="affine"), has_bias=True),
    "translation": Case(RegistrationSettings(warp="translation")),
    "rotation": Case(RegistrationSettings(warp="quartic", rotation=True)),
    "Zernike": Case(QUADRATIC, reconstruction=solving(basis="zernike")),
    "few modes": Case(QUADRATIC, reconstruction=solving(basis="zernike", pupil_modes=15)),
    "zonal": Case(QUADRATIC, reconstruction=solving(method="zonal"), has_bias=True),
    "circle": Case(QUADRATIC, is_circle=True),
    "ITK": Case(RegistrationSettings(method="itk_affine")),
    "stars": Case(RegistrationSettings(method="centroids", star_rows=2, star_columns=3), has_stars=True),
    "stars, zonal": Case(
        RegistrationSettings(method="centroids", star_rows=2, star_columns=3),
        has_stars=True,
        reconstruction=solving(method="zonal"),
    ),
}


def measured(case: Case, bench: SmallBench) -> Measurement:
    """Reconstruct a frame of a tilt that grows with the field, some lenslets of which are lost."""
    field = replace(FIELD, shape="circle") if case.is_circle else FIELD
    if case.has_stars:
        u, v = bench.samples()
        source = stars(Source(star_rows=2, star_columns=3))
        reference = bench.model.irradiance(source) * 1e14
        phase = phase_only(lambda x, _y: ((3000.0 + 1e6 * x) * u + 1000.0 * v).astype(np.float32))
        frame = bench.model.irradiance(source, phase) * 1e14
    else:
        reference, frame = bench.reference, bench.tilted(3000.0, 500.0)[0]
    frame = (frame * (4e4 / frame.max())).astype(np.uint16)
    reference = reference * (4e4 / reference.max())
    frame[: frame.shape[0] // 3] = 0  # the prior bridges one row
    settings = Bench(
        sensor=bench.sensor, field=field, registration=case.registration, reconstruction=case.reconstruction
    )
    calibration = Calibration.of_images(settings, reference.astype(np.float32), lattice=bench.lattice)
    reconstructor = calibration.reconstructor()
    registered = reconstructor.register(frame)
    bias = np.full(registered.coefficients.shape, 0.02) if case.has_bias else None
    return Measurement(
        make_frame(frame, index=7),
        reconstructor.solve(registered, bias=bias, sample=case.sample),
        "",
        FrameTotals(9, 8, 1),
        12.5,
        0.02,
        calibration=calibration,
        registered=registered,
        assumed=Assumptions(case.sample, RefinementState("applied", 0.75, 0.01, bias=bias)),
        quality=Quality({Fault.SCALE: "the scale"}),
        lost=1,
        light=LightState(True, 0.35),
        gap=Gap(0.2, "why"),
        file="frame.tif",
    )


@contextmanager
def border(ring: Path) -> Iterator[tuple[Publisher, RemoteFrames]]:
    """Publish to a client that reads everything, in this process."""
    publisher = Publisher(BENCH, ring)

    def ask(name: str, count: int) -> Future[Any]:
        return run_in_thread(lambda: unpacked(encoded(publisher.part(name, count))), "answer")[0]

    frames = RemoteFrames(ask, (), 0.0)
    publisher._notify = lambda: setattr(frames, "ring_name", publisher.ring_name)
    with publisher.running(), closing(frames):
        publisher.read_every(0.0)
        yield publisher, frames
    frames.join()


def received(publisher: Publisher, frames: RemoteFrames, made: Measurement) -> Measurement:
    before = frames.newest
    publisher.take(made)
    wait_until(lambda: frames.newest is not before or frames.error)
    assert frames.error is None
    assert frames.newest is not None
    return frames.newest


@pytest.mark.parametrize("name", CASES)
def test_frame_arrives_as_the_instrument_has_it(
    small_bench: SmallBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """No estimator is prepared for it, whatever is asked of the wavefront."""
    sent = measured(CASES[name], small_bench)
    monkeypatch.setattr("app.acquisition.remote.frames._ANSWER_S", HANG_S)  # the first ones are compiled
    monkeypatch.setattr(Reconstructor, "__init__", lambda *_, **__: pytest.fail("an estimator was prepared"))
    with border(tmp_path / "ring") as (publisher, frames):
        found = received(publisher, frames, sent)
        assert found.wavefront is not None
        assert found.registered is not None
        assert sent.wavefront is not None
        assert sent.registered is not None
        for here, there in (
            (found.registered, sent.registered),
            (found.wavefront.displacement, sent.wavefront.displacement),
        ):
            for part in ("coefficients", "outcome", "residual_rms", "chi_square", "range_used", "covariance"):
                np.testing.assert_array_equal(getattr(here, part), getattr(there, part), part)
        assert_same_wavefronts(found.wavefront, sent.wavefront)
        again = received(publisher, frames, sent)
    assert again.calibration is found.calibration
    np.testing.assert_array_equal(found.frame.pixels, sent.frame.pixels)
    for part in ("problem", "counts", "exposure_end_s", "latency_s", "lost", "light", "gap", "file", "index"):
        assert getattr(found, part) == getattr(sent, part)
    assert found.quality.reasons == sent.quality.reasons
    assert found.assumed.refinement == sent.assumed.refinement
    assert found.calibration is not None
    assert sent.calibration is not None
    assert found.calibration.bench == sent.calibration.bench
    np.testing.assert_array_equal(found.calibration.reference.mean, sent.calibration.reference.mean)


def assert_same_wavefronts(found: Wavefront, sent: Wavefront) -> None:
    np.testing.assert_array_equal(found.views, sent.views)
    assert 0 < np.isfinite(found.views).sum() < found.views.size
    np.testing.assert_array_equal(found.sigma(), sent.sigma())
    more = (Wavefront.of(one.sensor, with_views(one.field, 4), one.displacement, one.solution) for one in (found, sent))
    here, there = (each.sigma() for each in more)
    np.testing.assert_allclose(here, there, rtol=1e-4)
    at = np.array([-2e-4, 1.5e-4]), np.array([1e-4, 3e-4])
    np.testing.assert_array_equal(found.at(*at), sent.at(*at))
    assert found.sample.ratios == sent.sample.ratios
    np.testing.assert_array_equal(found.sample.sigma, sent.sample.sigma)
    assert (found.transmission is None) == (sent.transmission is None)
    for one, other in zip(found.transmission or (), sent.transmission or (), strict=True):
        np.testing.assert_array_equal(one, other)
    assert type(found.solution) is type(sent.solution)
    if isinstance(found.solution, ModalSolution) and isinstance(sent.solution, ModalSolution):
        for part in ("coefficients", "coefficients_sigma", "known", "misfit", "chi_square", "root_covariance"):
            np.testing.assert_array_equal(getattr(found.solution, part), getattr(sent.solution, part), part)
        rad, sent_rad = (fit_coefficients(ModalFit.of(each), "zernike", 3).rad for each in (found, sent))
        np.testing.assert_array_equal(rad, sent_rad)
        np.testing.assert_array_equal(
            slope_residual(found, found.solution.modes), slope_residual(sent, sent.solution.modes)
        )


def test_details_of_an_old_frame_are_computed_by_the_client(
    small_bench: SmallBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = measured(CASES["bias"], small_bench)
    assert sent.wavefront is not None
    with border(tmp_path / "ring") as (publisher, frames):
        found, old = received(publisher, frames, sent), received(publisher, frames, sent)
        for _ in range(20):
            received(publisher, frames, sent)
        assert found.wavefront is not None
        assert old.wavefront is not None
        with monkeypatch.context() as still:
            still.setattr(Reconstructor, "__init__", lambda *_, **__: pytest.fail("an estimator was prepared"))
            np.testing.assert_array_equal(found.wavefront.sigma(), sent.wavefront.sigma())
        monkeypatch.setattr("app.acquisition.streams.publisher._KEPT", 1)
        received(publisher, frames, sent)
        np.testing.assert_allclose(old.wavefront.sigma(), sent.wavefront.sigma(), rtol=1e-3)


def test_frame_that_cannot_be_sent_says_so_and_the_next_one_arrives(small_bench: SmallBench, tmp_path: Path) -> None:
    sent = measured(CASES["translation"], small_bench)
    with border(tmp_path / "ring") as (publisher, frames):
        found = received(publisher, frames, replace(sent, light={1, 2}))  # type: ignore[arg-type] # no plain data
        assert found.wavefront is None
        assert found.problem == "this frame cannot be shown: a set cannot be sent to another process"
        assert received(publisher, frames, sent).wavefront is not None


def test_fault_of_one_frame_is_printed_and_the_next_one_arrives(
    small_bench: SmallBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ValueError("fault")

    sent = measured(CASES["translation"], small_bench)
    with border(tmp_path / "ring") as (publisher, frames):
        with monkeypatch.context() as patched:
            patched.setattr("app.acquisition.streams.publisher.own_frame", fail)
            publisher.take(sent)
            wait_until(lambda: "svwfs: a frame was not published: ValueError('fault')" in capsys.readouterr().err)
        assert received(publisher, frames, sent).wavefront is not None


def test_nothing_is_encoded_that_nobody_takes(
    small_bench: SmallBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = measured(CASES["translation"], small_bench)
    calls: list[object] = []
    monkeypatch.setattr("app.acquisition.streams.publisher.own_frame", lambda *_, **__: calls.append(0))
    monkeypatch.setattr("app.acquisition.streams.publisher.topic_message", lambda *_: calls.append(0))
    publisher = Publisher(BENCH, tmp_path / "ring")
    with publisher.running():
        for _ in range(10):
            publisher.take(sent)
    assert not calls
    assert publisher.count == 10

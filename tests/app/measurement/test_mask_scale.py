"""The mask as a ruler, on frames of another simulator and on rendered ones."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special
from support.command_line import run
from support.paths import FOREIGN_FRAMES

from app.bench.config import Bench, load_bench
from app.evaluation.frames import NoiseFreeFrames
from app.images import read_image
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.measurement.mask_scale import MaskScale, mask_scale, scale_quality
from app.measurement.mask_scale import _fitted as fitted
from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.lattice.search import survey
from reconstruction.quality.verdict import Fault

REAL_LIGHT = FOREIGN_FRAMES / "real_light"


@cache
def other_simulator(mask: str) -> tuple[Bench, Image]:
    bench = load_bench(str(REAL_LIGHT / "bench.toml"), (f"simulation.source.mask={mask}",))
    name = "checker" if mask == "checkerboard" else mask
    light = read_image(REAL_LIGHT / f"{name}_reference.tif").astype(np.float32)
    return bench, light - np.percentile(light, 1).astype(np.float32)


def measured(bench: Bench, light: Image) -> MaskScale:
    found = mask_scale(bench, light)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("scale", "sigma", "off"), [(1.02, 0.01, ""), (1.04, 0.01, "4.0 % larger"), (0.98, 0, "2.0 % smaller")]
)
def test_scale_beyond_three_standard_errors_is_a_fault(scale: float, sigma: float, off: str) -> None:
    faults = MaskScale("square", scale, sigma, "").faults
    assert [off in fault for fault in faults] == [True] * bool(off)


def test_pattern_of_the_dark_is_no_part_of_the_mask() -> None:
    bench, light = other_simulator("square")
    assert bench.lattice is not None
    pattern = np.random.default_rng(5).uniform(0, 3 * light.max(), light.shape)
    reference, dark = Average.of_image((light + pattern).astype("f4")), Average.of_image(pattern.astype("f4"))
    source = replace(bench.simulation.source, half_width_m=1.05 * bench.simulation.source.half_width_m)
    larger = replace(bench, simulation=replace(bench.simulation, source=source))
    quality = scale_quality(
        Calibration(bench=larger, dark=dark, reference=reference, lattice=bench.lattice, full_scale=math.inf)
    )
    assert "4.8 % smaller" in quality.reasons[Fault.SCALE]  # 1 / 1.05


def test_error_of_the_scale_is_its_scatter_in_noise() -> None:
    """Squares of 14 px with edges blurred by 1.2 px, in noise of 2 %."""
    along = np.arange(25) - 12.0

    def square(scale: float) -> Floats:
        edges = (special.erf((along + side * 7 * scale) / (np.sqrt(2) * 1.2)) for side in (1, -1))
        line = np.subtract(*edges) / 2
        return np.asarray(np.outer(line, line))

    random = np.random.default_rng(4)
    found = [fitted(square, square(1.01) + random.normal(0, 0.02, (25, 25))) for _ in range(100)]
    _, scales, sigmas = np.array(found).T
    assert np.mean(scales) == pytest.approx(1.01, abs=4 * np.std(scales) / 10)
    assert np.mean(sigmas) == pytest.approx(np.std(scales), rel=0.25)


@pytest.mark.parametrize("mask", ["square", "checkerboard"])
def test_image_of_another_simulator_has_the_size_that_lengths_say(mask: str) -> None:
    bench, light = other_simulator(mask)
    found = measured(bench, light)
    assert found.scale == pytest.approx(1, abs=5e-4)
    assert found.faults == []


@pytest.mark.parametrize("factor", [0.95, 1.02])
@pytest.mark.parametrize("length", ["lenslet_focal_length_m", "collimator_focal_length_m", "half_width_m"])
def test_wrong_length_is_measured(length: str, factor: float) -> None:
    """The image is as large as half width times f over f1."""
    bench, light = other_simulator("square")
    if length == "lenslet_focal_length_m":
        wrong = replace(
            bench, sensor=replace(bench.sensor, lenslet_focal_length_m=factor * bench.sensor.lenslet_focal_length_m)
        )
    elif length == "collimator_focal_length_m":
        f1_m = bench.field.collimator_focal_length_m
        wrong = replace(bench, field=replace(bench.field, collimator_focal_length_m=f1_m / factor))
    else:
        source = bench.simulation.source
        source = replace(source, half_width_m=factor * source.half_width_m)
        wrong = replace(bench, simulation=replace(bench.simulation, source=source))
    found = measured(wrong, light)
    assert found.scale == pytest.approx(1 / factor, rel=1e-3)
    assert f"{100 * abs(1 / factor - 1):.1f} % {'larger' if factor < 1 else 'smaller'}" in found.faults[0]


@cache
def rendered(mask: str) -> tuple[Bench, Image]:
    """Bench with its true lattice, and its reference, photons over the brightest."""
    bench = load_bench("small_demo", (f"simulation.source.mask={mask}",))
    square = NoiseFreeFrames(bench).reference("square")
    lattice = survey(1e4 * square / square.max(), bench.sensor).lattice
    reference = NoiseFreeFrames(bench).reference()
    return replace(bench, lattice=lattice), reference / reference.max()


@pytest.mark.slow
@pytest.mark.parametrize("mask", ["square", "circle", "octagon", "checkerboard"])
def test_scale_in_little_light(mask: str) -> None:
    """1000 electrons in the brightest pixel of one frame; the scatter is that of the standard error."""
    bench, light = rendered(mask)
    deviations = []
    for seed in range(6):
        generator = np.random.default_rng(seed)
        counts = generator.poisson(1000 * light) + generator.normal(0, 8, light.shape)
        found = measured(bench, counts.astype(np.float32))
        assert found.scale == pytest.approx(1, abs=2e-3)
        deviations.append((found.scale - 1.0) / found.sigma)
    assert np.std(deviations) < 3


ORIENTATIONS: dict[str, Callable[[NDArray[np.uint8]], NDArray[np.uint8]]] = {
    "": lambda picture: picture,
    "mirrored left to right": np.fliplr,
    "mirrored top to bottom": np.flipud,
    "turned by 180 degrees": lambda picture: np.rot90(picture, 2),
    "turned by 90 degrees": lambda picture: np.rot90(picture, -1),  # from +x, right, to +y, down
    "turned by -90 degrees": np.rot90,
    "mirrored across its diagonal": np.transpose,
    "mirrored across its other diagonal": lambda picture: np.rot90(picture, 2).T,
}


@pytest.mark.parametrize(
    "orientation",
    [name if name == "turned by 90 degrees" else pytest.param(name, marks=pytest.mark.slow) for name in ORIENTATIONS],
)
def test_orientation_of_an_asymmetric_mask_is_found(tmp_path: Path, orientation: str) -> None:
    """A letter L beside the middle."""
    picture = np.zeros((12, 12), np.uint8)
    picture[2:5, 2:10] = picture[2:10, 2:4] = 255
    for name, shown in (("as_bench", picture), ("mounted", ORIENTATIONS[orientation](picture))):
        np.save(tmp_path / f"{name}.npy", shown)
    as_bench, mounted = (
        load_bench("small_demo", ("simulation.source.mask=image", f"simulation.source.file={tmp_path / name}.npy"))
        for name in ("as_bench", "mounted")
    )
    found = measured(replace(as_bench, lattice=rendered("square")[0].lattice), NoiseFreeFrames(mounted).reference())
    assert found.orientation == orientation
    assert found.scale == pytest.approx(1, abs=2e-3)
    assert orientation in " ".join(found.faults)
    assert bool(found.faults) == bool(orientation)


def test_reference_without_light_is_refused() -> None:
    bench, light = other_simulator("square")
    with pytest.raises(ReconstructionError, match="no light above its background"):
        mask_scale(bench, -light)


@pytest.mark.slow
def test_calibrate_tells_the_scale(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def calibrate(*settings: str) -> str:
        changes = [word for setting in settings for word in ("--set", setting)]
        images = (REAL_LIGHT / "square_reference.tif", "--bench", REAL_LIGHT / "bench.toml")
        assert run(monkeypatch, "calibrate", *images, *changes) == 0
        printed = capsys.readouterr()
        return printed.out + printed.err

    right = calibrate()
    assert "scale        0.99998 +- 0.00009" in right
    assert "scales every wavefront" not in right
    assert "3.8 % larger than the bench's lengths say" in calibrate("sensor.lenslet_focal_length_m=0.045")
    assert "unknown: the reference does not show the mask circle" in calibrate("simulation.source.mask=circle")


@pytest.mark.parametrize("found", [MaskScale("image", 1.02, 1e-3, "turned by 90 degrees"), None])
def test_json_has_scale_and_orientation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], found: MaskScale | None
) -> None:
    monkeypatch.setattr("app.measurement.mask_scale.mask_scale", lambda *_: found)
    images = (REAL_LIGHT / "square_reference.tif", "--bench", REAL_LIGHT / "bench.toml")
    assert run(monkeypatch, "calibrate", *images, "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    expected = (None, None, None) if found is None else (found.scale, found.sigma, found.orientation)
    assert (figures["scale"], figures["scale_sigma"], figures["orientation"]) == expected

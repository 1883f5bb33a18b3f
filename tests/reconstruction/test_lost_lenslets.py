"""Classification of lost lenslets, and refusal of invalid frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.optics import FIELD, SmallBench

from reconstruction.displacement import LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise
from reconstruction.frame.pixels import KnownCamera
from reconstruction.registration.gauss_newton import GaussNewton
from reconstruction.settings import RegistrationSettings
from reconstruction.wavefront import rms

TILT = 2000.0


@pytest.fixture(scope="module")
def tilted(small_bench: SmallBench) -> NDArray[np.float32]:
    u, v = small_bench.samples()
    return small_bench.frame(lambda _x, _y: (TILT * u + 0 * v).astype(np.float32))


def _cell(bench: SmallBench, row: int, column: int) -> tuple[slice, slice]:
    """The pixels of one lenslet's cell."""
    x, y = bench.lattice.lenslet_centers_px(7, 9)[row, column]
    return slice(int(y - 14), int(y + 16)), slice(int(x - 14), int(x + 16))


@pytest.mark.parametrize("method", ["zonal", "modal"])
def test_dark_lenslet_is_lost_and_does_not_affect_others(
    small_bench: SmallBench, tilted: NDArray[np.float32], method: str
) -> None:
    frame = tilted + np.random.default_rng(0).normal(0, 20, tilted.shape).astype(np.float32)
    frame[_cell(small_bench, 2, 5)] = np.random.default_rng(1).normal(0, 20, (30, 30))
    wavefront = small_bench.reconstructor("affine", method)(frame)
    assert wavefront.displacement.outcome[2, 5] == LensletStatus.DARK
    assert np.count_nonzero(~wavefront.displacement.valid) == 1
    assert np.isnan(wavefront.displacement.coefficients[2, 5]).all()
    truth = TILT * small_bench.pupil_x_m
    assert np.isnan(wavefront.views[:, :, 2, 5]).all()
    assert np.count_nonzero(np.isnan(wavefront.views[1, 1])) == 1
    assert rms(wavefront.views[1, 1] - truth) < 0.03


@pytest.mark.parametrize("method", ["gauss_newton", "itk_affine"])
def test_excluded_lenslet_is_lost_whatever_it_shows(
    small_bench: SmallBench, tilted: NDArray[np.float32], method: Any
) -> None:
    frame = tilted.copy()
    frame[_cell(small_bench, 2, 5)] = np.roll(frame[_cell(small_bench, 2, 5)], 3, axis=1)  # a false displacement
    settings = RegistrationSettings(method=method, warp="affine", excluded=((2, 5),))
    reconstruct = small_bench.reconstructor(registration=settings)
    wavefront = reconstruct(frame)
    assert np.argwhere(~wavefront.displacement.valid).tolist() == [[2, 5]]
    assert wavefront.displacement.outcome[2, 5] == LensletStatus.EXCLUDED
    untouched = reconstruct(tilted)
    np.testing.assert_allclose(wavefront.views, untouched.views, atol=1e-3)  # it goes on without it
    assert np.isnan(wavefront.views[1, 1, 2, 5])


def test_foreign_subimage_diverges(small_bench: SmallBench, tilted: NDArray[np.float32]) -> None:
    frame = tilted.copy()
    frame[_cell(small_bench, 3, 3)] = np.random.default_rng(2).uniform(0, tilted.max(), (30, 30))
    outcome = small_bench.reconstructor()(frame).displacement.outcome
    assert outcome[3, 3] == LensletStatus.DIVERGED
    assert np.count_nonzero(outcome) == 1


def test_subimage_beyond_cell_has_left_it(small_bench: SmallBench) -> None:
    u, v = small_bench.samples()
    slope = 7.5 * small_bench.sensor.slope_per_px  # 8.8 px of field and 7.5 px of shift are more than half a cell

    def phase(_x: float, _y: float) -> NDArray[np.float32]:
        return (slope * np.maximum(u - 1.25e-3, 0) + 0 * v).astype(np.float32)

    outcome = small_bench.reconstructor()(small_bench.frame(phase)).displacement.outcome
    assert set(outcome[:, 7:].ravel()) <= {LensletStatus.LEFT_CELL, LensletStatus.DIVERGED}
    assert np.all(outcome[:, :6] == LensletStatus.CONVERGED)


def test_lenslet_outside_camera_is_absent(small_bench: SmallBench, tilted: NDArray[np.float32]) -> None:
    reconstructor = small_bench.reconstructor(reference=small_bench.reference[:, :-25])
    outcome = reconstructor(tilted[:, :-25]).displacement.outcome
    assert np.all(outcome[:, 8] == LensletStatus.ABSENT)
    assert np.all(outcome[:, :8] == LensletStatus.CONVERGED)


NONSENSE: dict[str, Callable[[NDArray[np.float32]], NDArray[Any]]] = {
    "was the light on": lambda reference: np.random.default_rng(0).normal(500, 8, reference.shape),
    "no light": np.zeros_like,
    "not finite": lambda reference: np.where(np.arange(reference.shape[1]) == 7, np.nan, reference),
    "grey counts": lambda reference: reference > 1,
    "check .lattice.": lambda reference: reference[:60, :60],
}


@pytest.mark.parametrize("sentence", NONSENSE)
def test_invalid_reference_is_refused(small_bench: SmallBench, sentence: str) -> None:
    with pytest.raises(ReconstructionError, match=sentence):
        small_bench.reconstructor(reference=NONSENSE[sentence](small_bench.reference))


def test_dark_frame_is_refused(small_bench: SmallBench) -> None:
    noise = np.random.default_rng(0).normal(500, 8, small_bench.reference.shape)
    with pytest.raises(ReconstructionError, match="is the light on"):
        small_bench.reconstructor()(noise)


def test_dark_frame_of_a_known_camera_is_not_searched(small_bench: SmallBench, monkeypatch: pytest.MonkeyPatch) -> None:
    reconstructor = small_bench.reconstructor(noise=CameraNoise(1.0, 8.0))
    monkeypatch.setattr(GaussNewton, "__call__", lambda *_, **__: pytest.fail("searched"))
    with pytest.raises(ReconstructionError, match="is the light on"):
        reconstructor(np.random.default_rng(0).normal(500, 8, small_bench.reference.shape))


def test_frame_of_another_size_is_refused(small_bench: SmallBench, tilted: NDArray[np.float32]) -> None:
    with pytest.raises(ReconstructionError, match="pixels, but the reference has"):
        small_bench.reconstructor()(tilted[:-1])


def test_saturated_frame_is_refused(small_bench: SmallBench, tilted: NDArray[np.float32]) -> None:
    full_scale = tilted.max() / 3
    with pytest.raises(ReconstructionError, match="saturated: shorten the exposure"):
        small_bench.reconstructor(reference=small_bench.reference / 4, camera=KnownCamera(full_scale=full_scale))(
            np.minimum(tilted, full_scale)
        )


def _touched(small_bench: SmallBench, image: NDArray[np.float32], value: float) -> NDArray[np.float32]:
    """Set the pixel in the middle of every cell."""
    frame = image.copy()
    shape = small_bench.sensor.lenslets
    x, y = np.rint(small_bench.lattice.lenslet_centers_px(*shape)).astype(int).reshape(-1, 2).T
    frame[y, x] = value
    return frame


def test_few_saturated_pixels_in_every_cell_are_named(small_bench: SmallBench, tilted: NDArray[np.float32]) -> None:
    full_scale = 2 * float(tilted.max())
    settings = RegistrationSettings(method="itk_affine")  # it loses every lenslet with a saturated pixel
    reconstructor = small_bench.reconstructor(camera=KnownCamera(full_scale=full_scale), registration=settings)
    with pytest.raises(ReconstructionError, match=r"63 are saturated, shorten the exposure"):
        reconstructor(_touched(small_bench, tilted, full_scale))


def test_too_many_modes_are_refused(small_bench: SmallBench) -> None:
    for count in (64, 300):  # 63 lenslets
        with pytest.raises(ReconstructionError, match=f"cannot determine {count} pupil modes"):
            small_bench.reconstructor(pupil_modes=count)


def test_frame_beyond_dynamic_range_is_refused_with_reason(small_bench: SmallBench) -> None:
    u, v = small_bench.samples()
    slope = 7.0 * small_bench.sensor.slope_per_px  # 5.5 px are all that a cell allows
    frame = small_bench.frame(lambda _x, _y: (slope * u + 0 * v).astype(np.float32))
    with pytest.raises(ReconstructionError, match="beyond the dynamic range"):
        small_bench.reconstructor("affine")(frame)


def test_half_covered_lenslet_diverges(small_bench: SmallBench, tilted: NDArray[np.float32]) -> None:
    frame = tilted + np.random.default_rng(0).normal(0, 0.02 * tilted.max(), tilted.shape).astype(np.float32)
    rows, columns = _cell(small_bench, 3, 3)
    frame[rows, columns.start : columns.start + 15] = 0
    outcome = small_bench.reconstructor("quadratic")(frame).displacement.outcome
    assert outcome[3, 3] != LensletStatus.CONVERGED
    assert np.count_nonzero(outcome) == 1


@pytest.mark.slow
@pytest.mark.parametrize("method", ["itk_affine", "centroids"])
@pytest.mark.parametrize("integrate", ["modal", "zonal"])
def test_every_method_reconstructs_with_known_noise(
    small_bench: SmallBench, tilted: NDArray[np.float32], method: str, integrate: str
) -> None:
    per_electron = float(small_bench.reference.max()) / 1e4
    reconstructor = small_bench.reconstructor(
        method=integrate,
        pupil_modes=None,
        registration=RegistrationSettings(method=method, star_rows=1, star_columns=1),  # type: ignore[arg-type] # parametrised
        noise=CameraNoise(per_electron, 8 * per_electron),
    )
    assert np.isfinite(reconstructor(tilted).views).any()


def test_lenslets_are_weighted_by_their_light(small_bench: SmallBench, tilted: NDArray[np.float32]) -> None:
    columns = np.arange(small_bench.frame_shape[1])
    shade = np.where(columns < small_bench.frame_shape[1] / 2, 1.0, 0.1).astype(np.float32)
    per_electron = float(small_bench.reference.max()) / 1e3
    reconstructor = small_bench.reconstructor(
        "affine",
        pupil_modes=3,
        reference=small_bench.reference * shade,
        noise=CameraNoise(per_electron, 8 * per_electron),
    )
    displacement = reconstructor.register(tilted * shade)
    column, changes = np.indices((7, 9))[1], []
    for lenslets in (column < 4, column > 4):
        moved = displacement.coefficients + np.where(lenslets[..., None, None], 0.1, 0.0)
        views = reconstructor.solve(replace(displacement, coefficients=moved)).views
        changes.append(rms(views - reconstructor.solve(displacement).views).mean())
    assert changes[0] > 4 * changes[1]


def test_dark_neighbours_of_a_few_lit_lenslets_are_not_valid(small_bench: SmallBench) -> None:
    """4 of 63 lenslets are lit; most of the others show only noise."""
    lit = np.zeros(small_bench.frame_shape, np.bool_)
    for row in (2, 3):
        for column in (4, 5):
            lit[_cell(small_bench, row, column)] = True
    rng = np.random.default_rng(0)
    light = small_bench.reference / small_bench.reference.max() * 1e4
    reference = np.where(lit, light, 0) + rng.normal(0, 20, light.shape)
    frame = np.where(lit, light, 0) + rng.normal(0, 20, light.shape)
    reconstructor = small_bench.reconstructor("affine", "zonal", reference=reference.astype(np.float32))
    outcome = reconstructor.register(frame.astype(np.float32)).outcome
    assert np.count_nonzero(outcome == LensletStatus.CONVERGED) == 4
    assert np.count_nonzero(outcome == LensletStatus.ABSENT) == outcome.size - 4


def test_frame_of_another_mask_is_not_called_dark(small_bench: SmallBench, tilted: NDArray[np.float32]) -> None:
    noise = np.random.default_rng(0).uniform(0, tilted.max(), tilted.shape).astype(np.float32)
    with pytest.raises(ReconstructionError, match="check the mask"):
        small_bench.reconstructor()(noise)


def test_frame_with_too_few_matching_lenslets_is_at_fault(small_bench: SmallBench, tilted: NDArray[np.float32]) -> None:
    frame = np.random.default_rng(0).uniform(0, tilted.max(), tilted.shape).astype(np.float32)
    for column in range(2, 7):
        cell = _cell(small_bench, 3, column)
        frame[cell] = tilted[cell]
    reason = "5 valid lenslets cannot determine 10 pupil modes: .*; 58 subimages look different"
    with pytest.raises(ReconstructionError, match=reason) as fault:
        small_bench.reconstructor(pupil_modes=10)(frame)
    assert fault.value.image == "frame"


def test_field_that_fills_the_cells_is_refused(small_bench: SmallBench) -> None:
    """Its image is 2 x 0.95 mm x 46.7 / 200 = 27.7 px wide; 31.25 px less a blur of 2.7 px are 28.6 px."""
    small_bench.reconstructor(field=replace(FIELD, half_width_m=0.95e-3))
    with pytest.raises(ReconstructionError, match=r"29\.2 px wide, leaves no space .*: lower field\.half_width_m"):
        small_bench.reconstructor(field=replace(FIELD, half_width_m=1e-3))

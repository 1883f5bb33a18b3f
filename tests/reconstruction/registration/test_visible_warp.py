"""Displacements that a mask shows: those left out, those that stand for them, and their error bars."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from support.optics import FIELD, SmallBench
from support.polynomial_layers import PHASE, light

from app.bench.config import Bench
from app.bench.imaging_model import lenslet_model
from reconstruction.arrays import Image
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.modes.field_modes import LegendreModes, gradient_basis
from reconstruction.registration.gauss_newton import GaussNewton
from reconstruction.registration.gauss_newton import _template as template
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import FIELD_MODES, Warp
from reconstruction.solve.modal import ModalSolution
from simulated_devices.optics.lenslet_image import LensletImage


def registration(bench: SmallBench, warp: Warp) -> GaussNewton:
    modes = LegendreModes(FIELD_MODES[warp])
    return GaussNewton(bench.subimages(), modes, conserve_flux=bench.field.neglect_propagation, may_rotate=False)


@pytest.mark.parametrize(
    ("name", "warp", "hidden"),
    [
        ("small_bench", "affine", 0),  # of 5
        ("small_bench", "quadratic", 2),  # of 9
        ("checker_bench", "quadratic", 0),
        ("checker_bench", "quartic", 0),  # of 20
        ("paper_bench", "quadratic", 0),
    ],
)
def test_square_hides_what_moves_only_its_inside(
    request: pytest.FixtureRequest, name: str, warp: Warp, hidden: int
) -> None:
    method = registration(request.getfixturevalue(name), warp)
    assert method.hidden == hidden
    assert len(method.parameters) == len(gradient_basis(method.modes)) - hidden
    np.testing.assert_allclose(method.parameters @ method.parameters.T, np.eye(len(method.parameters)), atol=1e-6)


def test_hidden_displacements_leave_the_edges_of_a_square_still(small_bench: SmallBench) -> None:
    """What the parameters found do not tell: along x and along y, zero at the edges that it would move."""
    method = registration(small_bench, "quadratic")
    gradients = gradient_basis(method.modes)
    hidden = np.linalg.svd(method.alike @ gradients.T)[2][-2:] @ gradients  # (2, x modes and y modes)
    edge = np.linspace(-1, 1, 9)
    along_x = np.tensordot(hidden[:, :6], method.modes.values(1.0, edge), axes=1)
    along_y = np.tensordot(hidden[:, 6:], method.modes.values(edge, -1.0), axes=1)
    inside = np.tensordot(hidden.reshape(2, 2, 6), method.modes.values(0.0, 0.0), axes=1)
    assert np.abs([along_x, along_y]).max() < 0.25 * np.linalg.norm(inside, axis=1).min()


def test_similar_displacements_share_parameters(small_bench: SmallBench) -> None:
    """Any displacement of the modelled image, hidden or not, is found as the smoothest one that looks like it."""
    method, reference = registration(small_bench, "quadratic"), small_bench.subimages()
    model = LensletImage(
        small_bench.sensor, FIELD, small_bench.source, width=reference.width, pupil_samples=12, pixel_fill_factor=1.0
    )
    points, per_rad = len(model.position), 2 / small_bench.sensor.lenslet_pitch_m / small_bench.sensor.slope_per_px
    tilts = model.derivatives(1, np.ones((1, points)), np.zeros((1, points, 2)))
    moved = np.stack([tilts[0, 1, 0], tilts[1, 0, 0]]) / per_rad  # by a pixel along x and y
    x, y = np.meshgrid(*2 * [reference.steps_px / reference.half_width_px])
    gradients = gradient_basis(method.modes)
    changes = np.einsum("kaq,qyx,ayx->kyx", gradients.reshape(-1, 2, 6), method.modes.values(x, y), moved)
    found = method.response(model.image(), changes)  # (lenslet, displacement, K)
    np.testing.assert_allclose(found, np.broadcast_to(gradients @ method.alike.T, found.shape), atol=0.04)
    np.testing.assert_allclose(method.alike @ method.parameters.T, np.eye(len(method.parameters)), atol=1e-6)


def test_tilt_leaves_no_misfit_where_displacements_are_hidden(small_bench: SmallBench) -> None:
    """A tilt by two pixels: a constant stands for all displacements that move the same edges."""
    u, v = small_bench.samples()
    slope = small_bench.sensor.slope_per_px
    frame = small_bench.frame(lambda _x, _y: (slope * (2.0 * u - 1.3 * v)).astype(np.float32))
    nowhere = np.zeros(frame.shape, np.bool_)
    found = registration(small_bench, "quadratic")(frame, saturated=nowhere)
    assert np.abs(found.coefficients[:, :, 0] - [2.0, -1.3]).max() < 0.04
    assert np.median(found.residual_rms) < 0.003


def layered(bench: SmallBench) -> Image:
    """A frame behind a layer 60 mm before the lenslets."""
    u, v = bench.samples()
    phase, amplitude = (lambda x, y, k=k: light(PHASE, -0.3, u, v, x, y)[k].astype(np.float32) for k in (0, 1))
    return bench.frame(phase, amplitude)


@pytest.mark.slow
def test_what_is_hidden_keeps_the_variance_of_the_prior(small_bench: SmallBench, checker_bench: SmallBench) -> None:
    sigma = {}
    for name, bench in (("square", small_bench), ("checkerboard", checker_bench)):
        model = partial(lenslet_model, Bench(sensor=bench.sensor, field=FIELD, lattice=bench.lattice))
        solution = bench.reconstructor("quadratic", pupil_modes=None, lenslet_model=model)(layered(bench)).solution
        assert isinstance(solution, ModalSolution)
        sigma[name] = np.sqrt(np.mean(solution.coefficients_sigma[1:] ** 2, axis=0))  # of 1, x, y, P2(x), x y, P2(y)
    growth = sigma["square"] / sigma["checkerboard"]
    assert (growth[[0, 3, 5]] > 5).all()
    assert (growth[[1, 2, 4]] < 3).all()


@pytest.mark.parametrize("peak_e", [300.0, 2000.0, 20000.0])
def test_pixels_left_out_raise_the_scatter_by_less_than_two_percent(
    checker_bench: SmallBench, monkeypatch: pytest.MonkeyPatch, peak_e: float
) -> None:
    """The same noisy frames, fitted with the chosen pixels and with all: the ratio of their scatter is known well."""
    bench, read_noise, frames = checker_bench, 3.0, 12
    light = np.maximum(bench.tilted(3000.0, 800.0)[0] * np.float32(peak_e / bench.reference.max()), 0)
    reference = ReferenceSubimages(
        bench.reference * np.float32(peak_e / bench.reference.max()),
        sensor=bench.sensor,
        lattice=bench.lattice,
        field=bench.field,
        noise=KnownNoise(CameraNoise(1.0, read_noise)),
    )
    model = LensletImage(
        bench.sensor, FIELD, bench.source, width=reference.width, pupil_samples=12, pixel_fill_factor=1.0
    )

    def prepare() -> GaussNewton:
        return GaussNewton(reference, LegendreModes(15), conserve_flux=False, may_rotate=False, model=model)

    chosen = prepare()
    monkeypatch.setattr(template, "_informative", lambda _, weight: np.ones(weight.shape, np.bool_))
    nowhere = np.zeros(light.shape, np.bool_)
    methods, rng, squares = (chosen, prepare()), np.random.default_rng(1), np.zeros((frames, 2))
    assert chosen._warp.grid.light.shape[1] < 0.95 * methods[1]._warp.grid.light.shape[1]
    still = [method(light, saturated=nowhere) for method in methods]
    for frame in range(frames):
        noisy = (rng.poisson(light) + rng.normal(0, read_noise, light.shape)).astype(np.float32)
        found = [method(noisy, saturated=nowhere) for method in methods]
        assert all(each.valid.all() for each in found)
        squares[frame] = [np.sum((f.coefficients - s.coefficients) ** 2) for f, s in zip(found, still, strict=True)]
    ratio, without_one = (np.sqrt(s[..., 0] / s[..., 1]) for s in (squares.sum(axis=0), squares.sum(axis=0) - squares))
    error = np.sqrt((frames - 1) * np.mean((without_one - ratio) ** 2))  # by the jackknife
    assert error < 0.002
    assert 1 - 3 * error < ratio < 1.02 - 3 * error

"""Response of the registration against warps in closed form and against complete registrations of rendered frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import optimize
from support.optics import FIELD, SmallBench
from support.own_wavefronts import Lenslets, local_wave, model_of

from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.modes.field_modes import LegendreModes, ZernikeModes
from reconstruction.registration.gauss_newton import GaussNewton
from reconstruction.registration.response import fitting_model, linear_response, point_brightness
from reconstruction.registration.subimages import ReferenceSubimages
from simulated_devices.optics.lenslet_image import LensletImage
from simulated_devices.optics.source import SourcePoints

MODES = LegendreModes(6)


@dataclass(frozen=True, eq=False)
class Registered:
    """A registration with the model of its lenslets."""

    bench: SmallBench
    reference: ReferenceSubimages
    model: LensletImage
    method: GaussNewton
    response: Floats  # (lenslet, n, m, field_mode, K)


@pytest.fixture(scope="module", params=["checker_bench", "paper_bench"])
def registered(request: pytest.FixtureRequest) -> Registered:
    """In real light and in the paper's world."""
    bench: SmallBench = request.getfixturevalue(request.param)
    reference = bench.subimages()
    model = model_of(bench, bench.source, reference.width)
    method = GaussNewton(reference, MODES, conserve_flux=bench.field.neglect_propagation, may_rotate=False)
    return Registered(bench, reference, model, method, linear_response(method, model))


@pytest.mark.parametrize("modes", [MODES, ZernikeModes(6)])
@pytest.mark.parametrize("rotation", [False, True])
def test_warp_of_the_image_is_found_as_it_is(
    registered: Registered, modes: LegendreModes | ZernikeModes, rotation: bool
) -> None:
    reference, model = registered.reference, registered.model
    conserve_flux = registered.bench.field.neglect_propagation
    method = GaussNewton(reference, modes, conserve_flux=conserve_flux, may_rotate=rotation)
    image = model.image()
    points = len(model.position)
    tilts = model.derivatives(1, np.ones((1, points)), np.zeros((1, points, 2)))
    px_per_rad = 2 / registered.bench.sensor.lenslet_pitch_m / registered.bench.sensor.slope_per_px
    moved_x, moved_y = tilts[0, 1, 0] / px_per_rad, tilts[1, 0, 0] / px_per_rad  # per px: minus the gradient
    half_px = reference.half_width_px
    x, y = np.meshgrid(reference.steps_px / half_px, reference.steps_px / half_px)
    values, slopes = modes.values(x, y), modes.gradients(x, y) / half_px
    # Moved light, to first order; in the paper's world spread, too: minus the divergence of displacement times light.
    spread = slopes * image[..., None] * conserve_flux
    along_x, along_y = values * moved_x - spread[..., 0], values * moved_y - spread[..., 1]
    changes = np.tensordot(method.parameters, np.concatenate([along_x, along_y]), axes=1)
    found = method.response(image, changes)
    assert len(method.parameters) == (12 if rotation else 9)
    np.testing.assert_allclose(found, np.broadcast_to(np.eye(len(changes)), found.shape), atol=0.02)
    unit = 1e3  # in any unit
    np.testing.assert_allclose(method.response(unit * image, unit * changes), found, atol=1e-6)


def test_gain_and_offset_are_no_warp(registered: Registered) -> None:
    image = registered.model.image()
    found = registered.method.response(image, np.stack([image, np.full_like(image, image.mean())]))
    np.testing.assert_allclose(found, 0, atol=0.02)


def test_response_to_tilt_is_focal_length_over_wavenumber(registered: Registered) -> None:
    sensor = registered.bench.sensor
    px_per_rad = 2 / sensor.lenslet_pitch_m / sensor.slope_per_px  # f / k over the pixel pitch, per slope
    px = registered.response @ registered.method.parameters  # (lenslet, n, m, field_mode, x modes and y modes)
    along_x, along_y = px[:, 0, 1, 0], px[:, 1, 0, 0]
    expected = np.zeros(12)
    expected[0] = px_per_rad
    np.testing.assert_allclose(along_x, np.broadcast_to(expected, along_x.shape), atol=0.01 * px_per_rad)
    np.testing.assert_allclose(along_y, np.broadcast_to(np.roll(expected, 6), along_y.shape), atol=0.01 * px_per_rad)


def test_even_wavefronts_cause_no_displacement(registered: Registered) -> None:
    n, m = np.indices((5, 5))
    np.testing.assert_array_equal(registered.response[:, (n + m) % 2 == 0], 0)
    assert np.all(np.any(registered.response[:, ((n + m) % 2 == 1) & (n + m < 5)], axis=(0, 2, 3)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "m", "q"), [(0, 1, 0), (3, 0, 0), (1, 2, 0), (0, 1, 1), (1, 0, 1), (1, 0, 5), (0, 3, 2), (2, 1, 4)]
)
def test_response_matches_complete_registrations(registered: Registered, n: int, m: int, q: int) -> None:
    bench = registered.bench
    tilts = np.array([[0.3, -0.1], [-0.2, 0.45]]) * bench.sensor.slope_per_px
    found = [measured_response(bench, registered.method, (n, m, q), tilt=tilt) for tilt in tilts]
    measured, expected = np.mean(found, axis=(0, 1)), registered.response[:, n, m, q].mean(axis=0)
    assert np.linalg.norm(measured - expected) < 0.04 * np.linalg.norm(measured)


def measured_response(
    bench: SmallBench,
    method: GaussNewton,
    wave: tuple[int, int, int],
    *,
    tilt: Floats | tuple[float, float] = (0.0, 0.0),
    own: Floats | float = 0.0,
) -> Floats:
    """Parameters per rad of P_n(eta) P_m(xi) T_q, (lenslet, K), of rendered frames with a tilt, rad/m.

    The lenslets have the phase `own` (y, x).
    """
    n, m, q = wave
    (u, v), rad, (local, slope_u, slope_v) = bench.samples(), 0.3, local_wave(bench, n, m)
    per_slope = FIELD.collimator_focal_length_m / bench.sensor.wavenumber_rad_per_m / FIELD.half_width_m
    gathered = per_slope * 2 / bench.sensor.lenslet_pitch_m

    def registered_px(amplitude: float) -> Floats:
        def phase(x_m: float, y_m: float) -> Image:
            at_point = MODES.values(x_m / FIELD.half_width_m, y_m / FIELD.half_width_m)[q]
            return np.asarray(own + tilt[0] * u + tilt[1] * v + amplitude * at_point * local, np.float32)

        def light(x_m: float, y_m: float) -> Image:
            along_x, along_y = MODES.gradients(x_m / FIELD.half_width_m, y_m / FIELD.half_width_m)[q]
            stretch = 1 + amplitude * gathered * (along_x * slope_u + along_y * slope_v)  # a tensor product
            return np.asarray(np.sqrt(stretch), np.float32)

        frame = bench.frame(phase, None if bench.field.neglect_propagation else light)
        found = method(frame, saturated=np.zeros(frame.shape, np.bool_))
        assert found.valid.all()
        return np.asarray(np.swapaxes(found.coefficients, 2, 3).reshape(-1, 12) @ method.parameters.T)

    return (registered_px(rad) - registered_px(-rad)) / (2 * rad)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "m", "q"), [(1, 0, 5), (0, 3, 2)])
def test_response_is_that_of_each_lenslet(checker_bench: SmallBench, n: int, m: int, q: int) -> None:
    """Their own wavefronts change it as they change complete registrations, but for effects of second order."""
    measured, expected = [], []
    for lenslets in (Lenslets(checker_bench, 0.1), Lenslets(checker_bench)):
        method = GaussNewton(lenslets.reference, MODES, conserve_flux=False, may_rotate=False)
        measured.append(measured_response(checker_bench, method, (n, m, q), own=lenslets.phase))
        expected.append(linear_response(method, lenslets.model)[:, n, m, q])
    changed = measured[0] - measured[1]
    assert np.linalg.norm(changed - (expected[0] - expected[1])) < 0.3 * np.linalg.norm(changed)


def test_model_of_another_source_is_refused(registered: Registered) -> None:
    source = registered.bench.source
    narrow = SourcePoints(position_m=source.position_m * 0.8, area_m2=source.area_m2)
    model = model_of(registered.bench, narrow, registered.reference.width)
    with pytest.raises(
        ReconstructionError, match=r"the modelled reference differs from the measured one by \d+ % of its contrast"
    ):
        fitting_model(lambda _: model, registered.reference)


@pytest.mark.parametrize("registered", ["paper_bench"], indirect=True)  # a mean of moved checkerboards is blurred
def test_response_of_a_displaced_lenslet_is_that_of_the_others(registered: Registered) -> None:
    """A lattice with a wrong pitch: the outer lenslets lie a pixel beside the middle of their windows."""
    bench = registered.bench
    wrong = replace(bench.lattice, pitch_px=bench.lattice.pitch_px * 1.01)
    reference = ReferenceSubimages(bench.reference, sensor=bench.sensor, lattice=wrong, field=bench.field)
    method = GaussNewton(reference, MODES, conserve_flux=bench.field.neglect_propagation, may_rotate=False)
    model = model_of(bench, bench.source, reference.width)
    response = linear_response(method, model)
    largest = np.abs(registered.response).max()
    np.testing.assert_allclose(response, registered.response, atol=0.02 * largest)


@pytest.mark.parametrize("points", [12, 40])  # fewer and more than pixels
def test_brightness_of_points_is_that_of_least_squares_without_negative_light(points: int) -> None:
    random = np.random.default_rng(points)
    images, subimage = random.random((points, 5, 5), np.float32), random.random((5, 5))
    found = point_brightness(images, subimage)
    matrix = images.reshape(points, -1).T.astype(np.float64)
    expected, _ = optimize.nnls(matrix, subimage.ravel())
    assert (found >= 0).all()
    np.testing.assert_allclose(matrix @ found, matrix @ expected, rtol=1e-9)
    if points < subimage.size:
        np.testing.assert_allclose(found, expected, atol=1e-9)

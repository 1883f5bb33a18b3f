"""The Gauss-Newton fit against SciPy's least squares, on images warped in closed form.

In real light a warp keeps the brightness; in the paper's world it keeps the flux.
"""

import numpy as np
import pytest
from scipy import ndimage, optimize
from support.optics import FIELD, PAPER, sensor_of

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Lattice
from reconstruction.registration import prepare_registration
from reconstruction.registration.gauss_newton import GaussNewton
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings, Warp

PIXELS = 93  # 3 x 3 lenslets of 31 px
CENTER_PX = 46.0
HALF_PX = 8.7
REACH_PX = 12
POTENTIAL_DEGREE: dict[Warp, int] = {"affine": 2, "quadratic": 3, "cubic": 4, "quartic": 5}


def _light(x: Floats, y: Floats) -> Floats:
    """A blurred checkerboard, repeated in each cell, at distances from the middle of the frame, px."""
    x, y = (np.mod(each + 15.5, 31) - 15.5 for each in (x, y))
    edges = [1 / (1 + np.exp((np.abs(each) - HALF_PX) / 1.3)) for each in (x, y)]
    cells = np.sin(2.5 * np.pi * x / HALF_PX) * np.sin(2.5 * np.pi * y / HALF_PX)  # of 3.5 px
    return np.asarray(1000 * edges[0] * edges[1] * (1 + 0.95 * cells))


class Warped:
    """A frame, and the reference that it must be warped to: the gradient of a random potential over each cell."""

    def __init__(self, degree: int, seed: int, *, conserve_flux: bool) -> None:
        self.conserve_flux = conserve_flux
        self.powers = [(m - n, n) for m in range(1, degree + 1) for n in range(m + 1)]
        sizes = [1.4 / (m + n) ** 2 for m, n in self.powers]
        self.potential = np.random.default_rng(seed).normal(0, sizes)
        y, x = np.mgrid[:PIXELS, :PIXELS] - CENTER_PX
        self.frame = _light(x, y)
        cell_x, cell_y = (np.mod(each + 15.5, 31) - 15.5 for each in (x, y))
        moved, stretch = self.warp(self.potential, cell_x, cell_y)
        self.reference = (0.8 * _light(x + moved[0], y + moved[1]) + 20) * stretch

    def warp(self, potential: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Gradient of a potential, px, and the light over that displaced, at distances from a lenslet, px."""
        u, v = x / HALF_PX, y / HALF_PX
        moved, slopes = np.zeros((2, *x.shape)), np.zeros((3, *x.shape))
        for size, (m, n) in zip(potential, self.powers, strict=True):
            moved[0] += size * m * u ** max(m - 1, 0) * v**n
            moved[1] += size * n * u**m * v ** max(n - 1, 0)
            slopes[0] += size * m * (m - 1) * u ** max(m - 2, 0) * v**n
            slopes[1] += size * m * n * u ** max(m - 1, 0) * v ** max(n - 1, 0)
            slopes[2] += size * n * (n - 1) * u**m * v ** max(n - 2, 0)
        slopes /= HALF_PX
        if not self.conserve_flux:
            return moved, np.ones_like(x)
        return moved, (1 + slopes[0]) * (1 + slopes[2]) - slopes[1] ** 2

    def solved(self) -> Floats:
        """Displacement of the middle lenslet by least squares, px, (xy, row, column)."""
        y, x = np.mgrid[-REACH_PX : REACH_PX + 1, -REACH_PX : REACH_PX + 1].astype(float)
        spline = ndimage.spline_filter(self.frame, order=3, mode="mirror")
        middle = slice(int(CENTER_PX) - REACH_PX, int(CENTER_PX) + REACH_PX + 1)

        def residual(parameters: Floats) -> Floats:
            moved, stretch = self.warp(parameters[:-4], x, y)
            at = [CENTER_PX + y + moved[1], CENTER_PX + x + moved[0]]
            light = ndimage.map_coordinates(spline, at, order=3, mode="mirror", prefilter=False)
            gain, offset, along_x, along_y = parameters[-4:]
            varying = 0 if self.conserve_flux else (along_x * x + along_y * y) / HALF_PX
            warped = ((gain + varying) * light + offset) * stretch
            return np.asarray(warped - self.reference[middle, middle]).ravel()

        start = np.concatenate([np.zeros(len(self.powers)), [1.0, 0.0, 0.0, 0.0]])
        scale = np.r_[np.ones(len(self.powers)), 0.1, 10, 0.1, 0.1]
        found = optimize.least_squares(residual, start, xtol=1e-12, x_scale=scale)
        return self.warp(found.x[:-4], x, y)[0]


Y, X = np.mgrid[-REACH_PX : REACH_PX + 1, -REACH_PX : REACH_PX + 1].astype(float)
INSIDE = np.abs(X) + np.abs(Y) < HALF_PX


def displaced(case: Warped, warp: Warp, field: Field) -> Floats:
    """Displacement of the middle lenslet inside the square by the registration, px, (xy, pixel)."""
    lattice = Lattice(center_x_px=CENTER_PX, center_y_px=CENTER_PX, pitch_px=31.0)
    subimages = ReferenceSubimages(
        case.reference.astype(np.float32), sensor=sensor_of(3, 3), lattice=lattice, field=field
    )
    estimate = prepare_registration(subimages, RegistrationSettings(warp=warp), field)
    assert isinstance(estimate, GaussNewton)
    assert estimate.hidden == 0
    found = estimate(case.frame.astype(np.float32), saturated=np.zeros((PIXELS, PIXELS), np.bool_))
    assert found.valid[1, 1]
    values = found.modes.values(X / subimages.half_width_px, Y / subimages.half_width_px)
    return np.asarray(np.tensordot(found.coefficients[1, 1].T, values, axes=1)[:, INSIDE])


@pytest.mark.parametrize("field", [FIELD, PAPER], ids=["real light", "paper"])
@pytest.mark.parametrize(
    ("warp", "seed"),
    [("affine", 0), ("quadratic", 1), ("cubic", 0), pytest.param("quartic", 0, marks=pytest.mark.slow)],
)
def test_fit_solves_the_constrained_least_squares_problem(warp: Warp, seed: int, field: Field) -> None:
    case = Warped(POTENTIAL_DEGREE[warp], seed, conserve_flux=field.neglect_propagation)
    found, truth = displaced(case, warp, field), case.warp(case.potential, X, Y)[0][:, INSIDE]
    np.testing.assert_allclose(found, case.solved()[:, INSIDE], atol=2e-3)
    np.testing.assert_allclose(found, truth, atol=4e-3)
    assert np.abs(truth).max() > 0.4


@pytest.mark.parametrize(
    ("warp", "conserve_flux", "other"),
    [("quadratic", False, PAPER), ("cubic", True, FIELD)],  # a linear brightness would explain a quadratic determinant
    ids=["real light", "paper"],
)
def test_warp_of_the_other_world_is_not_recovered(warp: Warp, conserve_flux: bool, other: Field) -> None:
    case = Warped(POTENTIAL_DEGREE[warp], 0, conserve_flux=conserve_flux)
    truth = case.warp(case.potential, X, Y)[0][:, INSIDE]
    assert np.abs(displaced(case, warp, other) - truth).max() > 0.02


@pytest.mark.parametrize("warp", ["affine", "quadratic", "cubic", "quartic"])
def test_brightness_that_varies_linearly_is_no_displacement(warp: Warp) -> None:
    """As behind a sample that absorbs, by up to 15 % at the corners of the field."""
    case = Warped(POTENTIAL_DEGREE[warp], 0, conserve_flux=False)
    plain = displaced(case, warp, FIELD)
    y, x = np.mgrid[:PIXELS, :PIXELS] - CENTER_PX
    cell_x, cell_y = (np.mod(each + 15.5, 31) - 15.5 for each in (x, y))
    case.reference /= 1 + 0.1 * cell_x / HALF_PX - 0.05 * cell_y / HALF_PX
    np.testing.assert_allclose(displaced(case, warp, FIELD), plain, atol=0.02)

"""Centroids of spots in closed form: no bias from pixels, and error bars that hold in photon noise."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.optics import SmallBench
from support.spots import SpotBench, fractions

from reconstruction.arrays import Floats
from reconstruction.displacement import Displacement, LensletStatus
from reconstruction.errors import ReconstructionError
from reconstruction.frame.noise import CameraNoise, KnownNoise
from reconstruction.geometry import Arrangement
from reconstruction.registration import chosen, prepare_registration
from reconstruction.registration.centroids import Centroids
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import RegistrationSettings
from simulated_devices.optics.source import source_points, stars
from simulated_devices.settings import MASKS, Mask, Source

Image = NDArray[np.floating[Any]]
SIGMAS_PX = [1.0, 1.2, 1.6, 2.2]
BIAS_PX = 2e-3


def subimages(bench: SpotBench, reference: Image, **changes: Any) -> ReferenceSubimages:
    return ReferenceSubimages(
        reference.astype(np.float32), sensor=bench.sensor, lattice=bench.lattice, field=bench.field, **changes
    )


def registered(reference: ReferenceSubimages, frame: Image) -> Displacement:
    made = Centroids(reference, star_x=np.zeros(1), star_y=np.zeros(1))
    return made(frame.astype(np.float32), saturated=np.zeros(frame.shape, np.bool_))


def errors_px(bench: SpotBench, found: Displacement, moved_px: Floats) -> Floats:
    """Found minus true displacements, px, of valid lenslets along the lattice, (N, xy)."""
    return (found.coefficients[:, :, 0] - moved_px @ bench.lattice.turn.T)[found.valid]


@pytest.mark.parametrize("sigma_px", SIGMAS_PX)
@pytest.mark.parametrize("rotation_rad", [0.0, 0.3])
def test_spots_have_no_bias_at_any_fraction_of_a_pixel(sigma_px: float, rotation_rad: float) -> None:
    margin_px = 10 if not rotation_rad else 60
    bench = SpotBench(rotation_rad=rotation_rad, margin_px=margin_px)
    moved_px = fractions(12, 12)
    reference = bench.image(sigma_px=sigma_px, light=1e4) + 100.0
    frame = bench.image(moved_px, sigma_px=sigma_px, light=7e3) + 130.0
    found = registered(subimages(bench, reference), frame)
    assert found.valid.all()
    assert np.abs(errors_px(bench, found, moved_px)).max() < BIAS_PX


@pytest.mark.parametrize("sigma_px", SIGMAS_PX)
@pytest.mark.parametrize("is_known", [True, False])
def test_error_bars_hold_in_photon_noise(sigma_px: float, is_known: bool) -> None:
    bench, moved_px, rng = SpotBench(), fractions(12, 12), np.random.default_rng(3)
    read_noise, photons, background = 2.0, 3000.0, 4.0
    ratios, errors = [], []

    def exposed(image: Floats) -> Floats:
        return np.asarray(rng.poisson(image + background) + rng.normal(0, read_noise, image.shape) - background)

    for _ in range(4):
        reference = exposed(bench.image(sigma_px=sigma_px, light=photons))
        noise = KnownNoise(CameraNoise(1.0, math.hypot(read_noise, math.sqrt(background))), 1.0)
        made = subimages(bench, reference, noise=noise if is_known else KnownNoise(reference_frames=1.0))
        found = registered(made, exposed(bench.image(moved_px, sigma_px=sigma_px, light=photons)))
        assert found.valid.mean() > 0.99
        error = errors_px(bench, found, moved_px)
        errors.append(error)
        ratios.append(error / np.sqrt(found.variance[:, :, 0][found.valid]))
    within = np.mean(np.abs(np.concatenate(ratios)) < 1)
    assert 0.60 < within < 0.76
    all_px = np.concatenate(errors)
    assert np.abs(all_px.mean(axis=0)).max() < BIAS_PX + 4 * all_px.std() / math.sqrt(len(all_px))


def test_scatter_is_near_the_least_possible() -> None:
    """Cramer-Rao: sigma over the root of the photons, in frame and in reference."""
    bench, moved_px, rng = SpotBench(), fractions(12, 12), np.random.default_rng(5)
    sigma_px, photons = 1.5, 2000.0
    reference, frame = (bench.image(each, sigma_px=sigma_px, light=photons) for each in (0.0, moved_px))
    noise = KnownNoise(CameraNoise(1.0, 0.1), 1.0)
    error = [
        errors_px(
            bench,
            registered(subimages(bench, rng.poisson(reference) * 1.0, noise=noise), rng.poisson(frame) * 1.0),
            moved_px,
        )
        for _ in range(4)
    ]
    least_px = math.sqrt(2 * (sigma_px**2 + 1 / 12) / photons)
    assert np.std(np.concatenate(error)) < 1.25 * least_px


def test_blurred_spots_are_measured() -> None:
    """As those of a star through the atmosphere against a sharp reference: 4 times as wide."""
    bench, moved_px = SpotBench(pitch_px=30.0), fractions(12, 12)
    frame = bench.image(moved_px, sigma_px=4.0, light=2e4)
    found = registered(subimages(bench, bench.image(sigma_px=1.0, light=1e4)), frame)
    assert found.valid.all()
    assert np.abs(errors_px(bench, found, moved_px)).max() < 0.01


def test_dark_faint_and_far_spots_are_lost() -> None:
    bench, rng = SpotBench(), np.random.default_rng(1)
    noise = KnownNoise(CameraNoise(1.0, 5.0), 1.0)
    light = np.full((12, 12), 1e4)
    reference = subimages(bench, bench.image(sigma_px=1.2, light=light), noise=noise)
    moved_px = np.zeros((12, 12, 2))
    light[2, 3], light[4, 5], moved_px[7, 11] = 0.0, 30.0, (13.5, 0.0)
    frame = bench.image(moved_px, sigma_px=1.2, light=light)
    found = registered(reference, frame + rng.normal(0, 5, frame.shape))
    expected = np.full((12, 12), LensletStatus.CONVERGED)
    expected[2, 3] = expected[4, 5] = LensletStatus.DARK
    expected[7, 11] = LensletStatus.LEFT_CELL
    np.testing.assert_array_equal(found.outcome, expected)


@pytest.mark.parametrize(
    ("arrangement", "moved_px"),
    [("square", (11.5, 11.5)), ("square", (-11.5, 0.0)), ("hexagonal", (0.0, 12.5)), ("hexagonal", (11.5, -2.0))],
)
def test_spots_are_found_in_all_of_their_cell(arrangement: Arrangement, moved_px: tuple[float, float]) -> None:
    """Cells are 24 px wide; the corners of a hexagon lie 13.9 px from its middle."""
    bench = SpotBench(arrangement=arrangement, margin_px=30)
    reference = subimages(bench, bench.image(sigma_px=1.2, light=1e4))
    found = registered(reference, bench.image(np.array(moved_px), sigma_px=1.2, light=1e4))
    assert found.valid.all()
    assert np.abs(errors_px(bench, found, np.broadcast_to(moved_px, (12, 12, 2)))).max() < BIAS_PX
    assert 0.85 < found.range_used.max() <= 1


def test_noise_alone_shows_no_spots() -> None:
    bench, rng = SpotBench(), np.random.default_rng(1)
    image = bench.image(sigma_px=1.2, light=1e4)
    for noise in (KnownNoise(), KnownNoise(CameraNoise(1.0, 5.0), 1.0)):
        reference = subimages(bench, image, noise=noise)
        assert not registered(reference, rng.normal(0, 5, image.shape)).valid.any()


def test_stars_outside_the_field_are_left_out() -> None:
    """The default 3 x 3 stars of a pinhole mask do not lie in the field of a point source."""
    bench = SpotBench()
    reference = subimages(bench, bench.image(sigma_px=1.2, light=1e4))
    method = prepare_registration(reference, RegistrationSettings(method="centroids"), bench.field)
    light = bench.image(sigma_px=1.2, light=1e4).astype(np.float32)
    assert method(light, saturated=np.zeros(light.shape, np.bool_)).valid.all()
    settings = RegistrationSettings(method="centroids", star_rows=2)
    with pytest.raises(ReconstructionError, match=r"star_spacing_m does not suit the lenslets: star_y must lie in"):
        prepare_registration(reference, settings, bench.field)


def defocus_px(bench: SpotBench, farthest: float) -> Floats:
    """Displacements (row, column, xy), px, that grow from the middle, at the rim's middle to a share of the pitch."""
    away = bench.center_px - bench.center_px.mean(axis=(0, 1))
    return np.asarray(farthest * bench.lattice.pitch_px * away / (away @ bench.lattice.turn.T).max())


@pytest.mark.parametrize("rotation_rad", [0.0, 0.3])
def test_spots_beyond_their_cells_are_found_by_their_neighbours(rotation_rad: float) -> None:
    """Where a row of spots has left its cells, the next row's lie in them: they were taken for it, a pitch off."""
    bench = SpotBench(rotation_rad=rotation_rad, margin_px=60)
    moved_px = defocus_px(bench, 0.6)
    reference = subimages(bench, bench.image(sigma_px=1.2, light=1e4))
    found = registered(reference, bench.image(moved_px, sigma_px=1.2, light=1e4))
    assert found.valid.all()
    assert np.abs(errors_px(bench, found, moved_px)).max() < 0.01
    assert found.range_used.max() == 1


def test_faint_spots_at_the_rim_are_found_beyond_their_cells() -> None:
    """Not the brighter ones of their neighbours, which lie in their cells."""
    bench = SpotBench(margin_px=60)
    moved_px = defocus_px(bench, 0.6)
    light = np.full((12, 12), 1e4)
    light[[0, -1]], light[:, [0, -1]] = 2.5e3, 2.5e3
    found = registered(
        subimages(bench, bench.image(sigma_px=1.2, light=1e4)), bench.image(moved_px, sigma_px=1.2, light=light)
    )
    assert found.valid.all()
    assert np.abs(errors_px(bench, found, moved_px)).max() < 0.01


@pytest.mark.parametrize("farthest", [0.75, 0.8, 1.0])
def test_neighbours_torn_apart_have_left_their_cells(farthest: float) -> None:
    """Each spot lies nearer to the next lenslet, again and again: a sawtooth, whose slopes are those of a wavefront."""
    bench = SpotBench(margin_px=60)
    reference = subimages(bench, bench.image(sigma_px=1.2, light=1e4))
    found = registered(reference, bench.image(defocus_px(bench, farthest), sigma_px=1.2, light=1e4))
    assert np.mean(found.outcome == LensletStatus.LEFT_CELL) > 0.2


@pytest.mark.parametrize("case", ["one lenslet", "a step", "turbulence", "astigmatism"])
@pytest.mark.parametrize("count", [3, 5, 12])
def test_spots_that_no_neighbour_expects_are_found(case: str, count: int) -> None:
    """In their own cells: of a sample's local defect, of a segmented mirror, of turbulence, of few lenslets."""
    bench, rng = SpotBench(count, count), np.random.default_rng(6)
    pitch_px, row, column = bench.lattice.pitch_px, *np.indices((count, count))
    of_pitch = {
        "one lenslet": np.where((row == count // 2) & (column == count // 2), 0.45, 0.0),
        "a step": np.where(column < count // 2, -0.3, 0.3),
        "turbulence": rng.normal(0, 0.1, (count, count)),
        "astigmatism": (column - (count - 1) / 2) / (count - 1) * 0.96,
    }[case]
    moved_px = pitch_px * np.stack(
        [of_pitch, rng.permuted(of_pitch) if case == "turbulence" else 0 * of_pitch], axis=-1
    )
    found = registered(
        subimages(bench, bench.image(sigma_px=1.2, light=1e4)), bench.image(moved_px, sigma_px=1.2, light=1e4)
    )
    assert found.valid.all()
    assert np.abs(errors_px(bench, found, moved_px)).max() < 0.01


def test_spots_of_others_and_noise_are_lost() -> None:
    """In the cells of missing spots, as near the edge of a star's light on a larger reference."""
    bench, rng = SpotBench(16, 16), np.random.default_rng(5)
    column = np.arange(16)
    lit = np.broadcast_to(column < 7, (16, 16))
    moved_px = np.zeros((16, 16, 2))
    moved_px[:, :, 0] = 0.47 * bench.lattice.pitch_px * column / 6  # the last lit ones lie almost in dark cells
    reference = subimages(bench, bench.image(sigma_px=1.0, light=1e3))
    stray = np.where(column == 9, 60.0, 0.0)  # in dark cells, beside their middles
    frame = bench.image(moved_px, sigma_px=1.0, light=1e3, lit=lit)
    frame = frame + bench.image(np.array([9.0, -8.0]), sigma_px=1.0, light=np.broadcast_to(stray, (16, 16)))
    found = registered(reference, rng.poisson(frame + 4) - 4.0)
    assert found.valid[lit].all()
    assert np.abs(errors_px(bench, found, moved_px)).max() < 0.2
    assert not found.valid[~lit].any()
    assert (found.outcome[:, 10:] == LensletStatus.DARK).all()


@pytest.mark.parametrize("sigma_px", [0.4, 0.6, 6.0])
def test_size_of_spots_is_found_from_a_wrong_diffraction(sigma_px: float) -> None:
    """Of a bench whose blur is 3.7 px: sums over fewer pixels are no moments, and had led to ever smaller sizes."""
    bench, rng = SpotBench(6, 6, pitch_px=60.0), np.random.default_rng(2)
    reference = subimages(bench, rng.poisson(bench.image(sigma_px=sigma_px, light=1e5) + 20) - 20.0)
    found = Centroids(reference, star_x=np.zeros(1), star_y=np.zeros(1)).sigma_px
    assert found == pytest.approx(max(math.hypot(sigma_px, math.sqrt(1 / 12)), 0.5), rel=0.1)


@pytest.mark.parametrize("picture", ["square", "ring"])
def test_any_image_of_a_field_that_is_not_resolved_is_a_spot(picture: str) -> None:
    """It shows no warp: a quartic one over half a pixel took such images beyond their cells."""
    steps = np.linspace(-5, 5, 6)
    square = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    ring = 7 * np.exp(2j * np.pi * np.arange(24) / 24).view(np.float64).reshape(-1, 2)
    for half_width_px, method in ((0.4, "centroids"), (6.0, "gauss_newton")):
        bench = SpotBench(field_half_width_px=half_width_px)
        moved_px = {"square": square, "ring": ring}[picture]
        image, moved = (
            np.sum([bench.image(each + by, sigma_px=1.2, light=500.0) for each in moved_px], axis=0)
            for by in (np.zeros(2), np.array([1.7, -0.6]))
        )
        reference = subimages(bench, image)
        assert chosen(RegistrationSettings(), reference)[0].method == method
        if method == "centroids":
            found = registered(reference, moved)
            assert found.valid.all()
            assert np.abs(errors_px(bench, found, np.broadcast_to([1.7, -0.6], (12, 12, 2)))).max() < 0.02


def test_dark_cells_are_absent_in_noise_and_on_a_slope() -> None:
    """Their contrast is that of the spots, but neighbouring pixels share none of it, or a plane."""
    bench, rng = SpotBench(), np.random.default_rng(4)
    lit = np.indices((12, 12)).sum(axis=0) < 11
    slope = np.linspace(0, 400, bench.shape[1])
    image = bench.image(sigma_px=1.0, light=600.0, lit=lit) + slope + rng.normal(0, 4, bench.shape)
    reference = subimages(bench, image)
    np.testing.assert_array_equal(reference.lit.reshape(12, 12), lit)
    assert reference.contrast[~reference.lit].min() > 0.3 * np.median(reference.contrast[reference.lit])


@pytest.mark.parametrize("sigma_px", [0.8, 1.2, 2.2, 3.0])
@pytest.mark.parametrize("field_half_width_px", [1.0, 8.0])
def test_spots_choose_centroids(sigma_px: float, field_half_width_px: float) -> None:
    """Also where the bench gives a field that is wider than the spots, and in noise."""
    bench, rng = SpotBench(field_half_width_px=field_half_width_px), np.random.default_rng(2)
    reference = rng.poisson(bench.image(sigma_px=sigma_px, light=2e3) + 20) - 20.0
    settings, why = chosen(RegistrationSettings(), subimages(bench, reference))
    assert (settings.method, settings.star_rows, settings.star_columns) == ("centroids", 1, 1)
    (shown_px,) = re.findall(r"each lenslet of the reference shows one spot \(sigma (\S+) px\)", why)
    assert float(shown_px) == pytest.approx(math.hypot(sigma_px, math.sqrt(1 / 12)), abs=0.15)
    for given in (RegistrationSettings(method="gauss_newton"), RegistrationSettings(method="centroids", star_rows=3)):
        assert chosen(given, subimages(bench, reference)) == (given, "")
    assert chosen(RegistrationSettings(warp="affine"), subimages(bench, reference))[0].method == "gauss_newton"


def test_spots_with_a_halo_choose_centroids() -> None:
    """Cores in wide haloes, as those of a Hartmann sensor, resemble no single Gaussian."""
    bench = SpotBench()
    reference = bench.image(sigma_px=1.0, light=2e3) + bench.image(sigma_px=3.0, light=6e3)
    assert chosen(RegistrationSettings(), subimages(bench, reference))[0].method == "centroids"


@pytest.mark.parametrize("mask", [mask for mask in MASKS if mask != "image"])
def test_pictures_choose_gauss_newton(mask: Mask) -> None:
    source = stars(Source()) if mask == "stars" else source_points(mask, Source(), object_samples=19)
    settings, why = chosen(RegistrationSettings(), SmallBench(5, 5, source=source).subimages())
    assert (settings.method, why) == ("gauss_newton", "gauss_newton, because the reference shows pictures, not spots")

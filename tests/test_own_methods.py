"""Registration methods and bases from outside the source tree, and one list of ours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from numpy.polynomial.legendre import poly2leg
from support.command_line import run
from support.optics import sensor_of

import svwfs
from app.evaluation.frames import SimulatedFrames
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Field, Sensor
from reconstruction.modes.polynomials import legendre_products, zernike_products
from reconstruction.modes.pupil_modes import BASES, PupilModes, polynomial_modes, pupil_modes
from reconstruction.registration import prepare_registration
from reconstruction.registration.centroids import Centroids
from reconstruction.registration.subimages import ReferenceSubimages
from reconstruction.settings import PupilBasis, RegistrationSettings

FIXED = svwfs.load_bench("small_demo", "reconstruction.pupil_modes=10", "registration.warp=affine")  # no prior


@pytest.fixture(scope="module")
def images() -> SimulatedFrames:
    return svwfs.simulate(FIXED)


def monomials(sensor: Sensor, count: int | None) -> PupilModes:
    powers = [(degree - n, n) for degree in range(7) for n in range(degree + 1)][:count]
    products = np.zeros((len(powers), 7, 7))
    for mode, (m, n) in enumerate(powers):
        products[mode, : n + 1, : m + 1] = np.outer(poly2leg([0] * n + [1]), poly2leg([0] * m + [1]))
    return polynomial_modes(sensor, products)


def own_centroids(reference: ReferenceSubimages, field: Field) -> Centroids:
    assert field == FIXED.field
    return Centroids(reference, star_x=np.zeros(1), star_y=np.zeros(1))


def test_own_basis_of_the_same_polynomials_gives_the_same_wavefront(images: SimulatedFrames) -> None:
    frame = images.frames[0]
    usual = svwfs.reconstructor(FIXED, images.reference, dark=images.dark)(frame)
    own = svwfs.reconstructor(FIXED, images.reference, dark=images.dark, basis=monomials)(frame)
    np.testing.assert_allclose(own.views, usual.views, atol=1e-3 * np.abs(usual.views).max())
    np.testing.assert_allclose(own.sigma(), usual.sigma(), rtol=1e-2)
    assert own.coefficients is not None
    assert usual.coefficients is not None
    assert np.abs(own.coefficients - usual.coefficients).max() > 0.1
    of_own, of_usual = (svwfs.field_coefficients(each, degree=3)["coefficient"] for each in (own, usual))
    np.testing.assert_allclose(of_own, of_usual, atol=1e-3 * float(abs(of_usual).max()))


@pytest.mark.slow
@pytest.mark.long
def test_own_registration_is_used_for_frame_and_refinement(images: SimulatedFrames) -> None:
    one_star = ("registration.method=centroids", "registration.star_rows=1", "registration.star_columns=1")
    bench = svwfs.load_bench("small_demo", *one_star, "reconstruction.pupil_modes=10")
    usual = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    own = svwfs.reconstructor(FIXED, images.reference, dark=images.dark, registration=own_centroids)
    np.testing.assert_array_equal(own(images.frames[0]).views, usual(images.frames[0]).views)
    of_own, of_usual = (svwfs.refine(each, images.frames[0], 1).views for each in (own, usual))
    np.testing.assert_array_equal(of_own, of_usual)


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"registration": "correlation"}, "an own registration must be a callable, .*, not 'correlation'"),
    ({"registration": lambda: None}, "an own registration must take other arguments, .*: too many positional"),
    ({"registration": lambda *_: None}, "an own registration must return a callable that registers frames, .* None"),
    ({"registration": lambda *_: abs}, "a prepared own registration must take other arguments"),
    (
        {"registration": lambda *_: lambda *_, **_more: 3},
        "a prepared own registration must return a Displacement, .* 3",
    ),
    ({"basis": 3}, "an own basis must be a callable, as in svwfs docs extending, not 3"),
    ({"basis": lambda sensor: sensor}, "an own basis must take other arguments"),
    ({"basis": lambda *_: np.ones((4, 7, 7))}, "an own basis must return a PupilModes, .* array"),
    ({"basis": lambda _, count: monomials(sensor_of(9, 9), count)}, r"values of an own basis must be of \(7, 7\)"),
]


@pytest.mark.parametrize(("wrong", "sentence"), WRONG)
def test_wrong_objects_as_own_methods_are_one_sentence(
    images: SimulatedFrames, wrong: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ReconstructionError, match=sentence):
        svwfs.reconstructor(FIXED, images.reference, dark=images.dark, **wrong)(images.frames[0])


def test_results_name_own_methods_and_are_refused_by_those_who_lack_them(
    images: SimulatedFrames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = svwfs.reconstructor(FIXED, images.reference, dark=images.dark, basis=monomials)
    svwfs.save_result(tmp_path / "r.nc", own(images.frames[0]), own.bench)
    with svwfs.open_result(tmp_path / "r.nc") as result:
        assert 'basis = "own monomials"' in result.attrs["bench"]
    assert run(monkeypatch, "field", tmp_path / "r.nc", "--out", tmp_path / "f.nc") == 2
    said = capsys.readouterr().err
    known = ", ".join(f'"{name}"' for name in get_args(PupilBasis))
    assert f"reconstruction.basis must be one of {known}" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("arrangement", ["square", "hexagonal"])
@pytest.mark.parametrize("basis", ["legendre", "zernike"])
def test_modes_of_polynomials_are_those_of_our_bases(basis: PupilBasis, arrangement: Any) -> None:
    sensor = replace(sensor_of(6, 9), arrangement=arrangement)
    half_m = np.array(sensor.pupil_half_width_m)
    products = legendre_products(28) if basis == "legendre" else zernike_products(28, *(half_m / half_m.min()))
    ours = pupil_modes(sensor, basis, 28)
    made = polynomial_modes(sensor, products, ours.inside)
    np.testing.assert_allclose(made.values, ours.values, atol=1e-9)
    np.testing.assert_allclose(made.gradients, ours.gradients, atol=1e-9 * np.abs(ours.gradients).max())
    np.testing.assert_array_equal(made.degree, ours.degree)
    with pytest.raises(ValueError, match="piston"):
        polynomial_modes(sensor, products[1:])


def test_unknown_names_are_refused(images: SimulatedFrames) -> None:
    unknown: Any = "no_such"
    with pytest.raises(ReconstructionError, match=f"no basis no_such: it must be {' or '.join(BASES)}"):
        pupil_modes(FIXED.sensor, unknown, 10)
    reconstruct = svwfs.reconstructor(FIXED, images.reference, dark=images.dark)
    with pytest.raises(ReconstructionError, match="there is no registration method no_such: it must be one of"):
        prepare_registration(
            reconstruct.estimator().reconstructor.subimages, RegistrationSettings(method=unknown), FIXED.field
        )

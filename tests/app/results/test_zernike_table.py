"""Tables of Zernike coefficients of `svwfs reconstruct`, `field`, `compare` and `export`, of spots in closed form."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from support.command_line import run
from support.pictures import assert_drawn
from support.round_spots import RADIUS_M, TRUE_RAD, WAVELENGTH_M, write_spots

from app.errors import InputError
from app.results.zernike_table import modes_named

NM, WAVES = WAVELENGTH_M / (2 * np.pi) * 1e9, 1 / (2 * np.pi)  # of a radian


@pytest.fixture(scope="module")
def spots(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    return write_spots(tmp_path_factory.mktemp("spots"))


def reconstruct(
    monkeypatch: pytest.MonkeyPatch, spots: tuple[Path, Path, Path], out: Path, *more: str | Path
) -> list[dict[str, str]]:
    """Reconstruct the frame; return the rows of its table."""
    frame, reference, bench = spots
    table = out.with_suffix(".csv")
    files = ("--reference", reference, "--bench", bench, "--out", out, "--table", table)
    assert run(monkeypatch, "reconstruct", frame, *files, *more) == 0
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


ORDERS = {"noll": (4, 6, 5), "osa": (4, 5, 3), "fringe": (4, 5, 6)}  # numbers of `TRUE_RAD`


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "more"),
    [
        *((order, ()) for order in ORDERS),
        ("noll", ("--set", "reconstruction.method=zonal")),
        ("osa", ("--set", "registration.method=centroids")),
    ],
)
def test_table_has_the_true_coefficients_in_every_order(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    spots: tuple[Path, Path, Path],
    order: str,
    more: tuple[str, ...],
) -> None:
    numbers = ORDERS[order]
    rows = reconstruct(monkeypatch, spots, tmp_path / "r.nc", "--order", order, *more)
    tolerance = 0.07 if "reconstruction.method=zonal" in more else 0.01  # Southwell's equations bend a parabola
    for (name, rad), number in zip(TRUE_RAD.items(), numbers, strict=True):
        (row,) = (row for row in rows if row["name"] == name)
        norm = np.sqrt(3 if name == "defocus" else 6) if order == "fringe" else 1.0
        assert int(row["number"]) == number
        found = float(row["rad"]) / float(norm)
        assert found == pytest.approx(rad, abs=tolerance)
        assert float(row["nm"]) == pytest.approx(float(row["rad"]) * NM)
        assert float(row["waves"]) == pytest.approx(float(row["rad"]) * WAVES)
    others = [float(row["rad"]) for row in rows if row["name"] not in TRUE_RAD]
    np.testing.assert_allclose(others, 0, atol=0.02 if order != "fringe" else 0.08)
    printed = capsys.readouterr().out
    assert f"Z{numbers[0]} defocus" in printed
    assert {"noll": "Noll's order, unit RMS", "osa": "OSA/ANSI", "fringe": "unit amplitude"}[order] in printed
    assert f"pupil {2e3 * RADIUS_M:.2f} mm, in which 76 of the 76 valid lenslets lie" in printed


@pytest.mark.slow
def test_results_file_says_axes_basis_order_and_pupil(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, spots: tuple[Path, Path, Path]
) -> None:
    out = tmp_path / "r.nc"
    reconstruct(monkeypatch, spots, out, "--set", "reconstruction.basis=zernike", "--order", "osa")
    with xr.open_dataset(out) as found:
        assert "turned by lattice_rotation_rad" in found.attrs["axes"]
        assert (found.attrs["pupil"], found.attrs["pupil_radius_m"]) == ("circle", pytest.approx(RADIUS_M))
        assert found.attrs["pupil_center_m"].tolist() == [0, 0]
        assert found["pupil_mode_name"].values[3] == "Z4 defocus"
        assert "unit RMS" in found["pupil_mode_name"].attrs["long_name"]
        assert found["zernike_number"].values.tolist() == list(range(1, 15))
        assert "OSA/ANSI" in found["zernike"].attrs["long_name"]
        by_name = dict(zip(found["zernike_name"].values, found["zernike_nm"].values[0, 0], strict=True))
        assert by_name["Z4 defocus"] == pytest.approx(TRUE_RAD["defocus"] * NM, rel=0.02)
        for name in ("rms", "pv"):
            np.testing.assert_allclose(found[f"{name}_nm"], found[name] * NM)
            np.testing.assert_allclose(found[f"{name}_waves"], found[name] * WAVES)
            assert found[f"{name}_waves"].attrs["units"] == "waves"
        x, y = found["pupil_x"].values / RADIUS_M, found["pupil_y"].values[:, None] / RADIUS_M
        np.testing.assert_array_equal(np.isfinite(found["wavefront"].values[0, 0]), np.hypot(x, y) <= 1)


def test_frame_a_lenslet_off_is_flagged_above_a_dark_of_whole_counts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Differences of unsigned counts wrap, which had hidden the edge of the light."""
    spots, dark = write_spots(tmp_path), tmp_path / "dark.tif"
    image = tifffile.imread(spots[0])
    tifffile.imwrite(spots[0], np.roll(image, (24, -24), (0, 1)))
    tifffile.imwrite(dark, np.random.default_rng(5).poisson(100, image.shape).astype(np.uint16))
    reconstruct(monkeypatch, spots, tmp_path / "r.nc", "--dark", dark)
    shown = " ".join(capsys.readouterr().out.split())
    assert "the lenslets with light are displaced by (-24, +24) px" in shown


@pytest.mark.slow
def test_hot_pixels_light_no_lenslet_of_the_pupil(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    spots = write_spots(tmp_path)
    bench = spots[2].read_text()
    spots[2].write_text(bench[: bench.index("[pupil]")])
    reconstruct(monkeypatch, spots, tmp_path / "clean.nc")
    for path in spots[:2]:
        image = tifffile.imread(path)
        image[[13, 14, 270, 275], [15, 268, 11, 274]] = 30_000  # in the corners, which are dark
        tifffile.imwrite(path, image)
    reconstruct(monkeypatch, spots, tmp_path / "hot.nc")
    with xr.open_dataset(tmp_path / "clean.nc") as clean, xr.open_dataset(tmp_path / "hot.nc") as hot:
        assert clean.attrs["pupil"] == "circle"
        assert hot.attrs["pupil_radius_m"] == clean.attrs["pupil_radius_m"]


@pytest.mark.slow
def test_removed_modes_leave_rms_of_the_others(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, spots: tuple[Path, Path, Path]
) -> None:
    out = tmp_path / "r.nc"
    rows = reconstruct(monkeypatch, spots, out, "--remove", "Tilt, defocus")
    left_rad = float(np.linalg.norm(list(TRUE_RAD.values())[1:]))
    assert "without Tilt, defocus: RMS" in capsys.readouterr().out
    with xr.open_dataset(out) as found:
        assert float(found["rms"].item()) == pytest.approx(left_rad, rel=0.06)  # over lenslet centres, not the circle
        assert found.attrs["removed"] == "Tilt, defocus"
    (defocus,) = (row for row in rows if row["name"] == "defocus")  # the table keeps what was measured
    assert float(defocus["rad"]) == pytest.approx(TRUE_RAD["defocus"], abs=0.01)


@pytest.mark.slow
def test_annular_coefficients_of_an_obscured_pupil(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    e = 0.3
    spots = write_spots(tmp_path, obscuration=e)
    turned = ("--set", "lattice.rotation_rad=0.002", "--set", "pupil.shape=all", "--set", "pupil.radius_m=1e-3")
    reconstruct(monkeypatch, spots, tmp_path / "all.nc", *turned)
    printed = capsys.readouterr().out
    assert "turned by +0.002 rad from the camera's" in printed
    assert "circle inscribed in the lattice: 2.88 mm, in which 72 of the 72 valid lenslets lie" in printed
    more = ("--set", "pupil.shape=annulus", "--set", f"pupil.obscuration={e}")
    rows = {row["name"]: float(row["rad"]) for row in reconstruct(monkeypatch, spots, tmp_path / "r.nc", *more)}
    assert "obscuration 30 %" in capsys.readouterr().out
    # Mahajan: defocus sqrt(3) (2 r^2 - 1 - e^2) / (1 - e^2), astigmatism sqrt(6) r^2 cos(2 t) / sqrt(1 + e^2 + e^4)
    assert rows["defocus"] == pytest.approx(TRUE_RAD["defocus"] * (1 - e**2), abs=0.01)
    for name in list(TRUE_RAD)[1:]:
        assert rows[name] == pytest.approx(TRUE_RAD[name] * np.sqrt(1 + e**2 + e**4), abs=0.01)


@pytest.mark.slow
def test_pupil_is_found_from_the_lit_lenslets(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    frame, reference, bench = write_spots(tmp_path, obscuration=0.3)
    bench.write_text(bench.read_text().partition("[pupil]")[0])
    reconstruct(monkeypatch, (frame, reference, bench), tmp_path / "r.nc")
    assert "in which 72 of the 72 valid lenslets lie" in capsys.readouterr().out
    with xr.open_dataset(tmp_path / "r.nc") as found:
        assert found.attrs["pupil"] == "annulus"
        assert found.attrs["pupil_radius_m"] == pytest.approx(RADIUS_M, rel=0.05)
        assert found.attrs["pupil_obscuration"] == pytest.approx(0.2, abs=0.1)  # of four lenslets
        assert np.isnan(found["wavefront"].values[0, 0, 5:7, 5:7]).all()
    # The file has the pupil that was found: the field is that of the same annulus.
    assert run(monkeypatch, "field", tmp_path / "r.nc", "--out", tmp_path / "f.nc") == 0
    with xr.open_dataset(tmp_path / "f.nc") as field, xr.open_dataset(tmp_path / "r.nc") as found:
        assert field.attrs["xy_inner"] / field.attrs["xy_outer"] == pytest.approx(found.attrs["pupil_obscuration"])
        at_view = field["coefficient"].sel(x=0, y=0).values
        np.testing.assert_allclose(at_view, found["zernike"].values[0, 0], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "more", [("registration.warp=translation",), ("reconstruction.method=zonal",), ("registration.method=centroids",)]
)
def test_every_result_has_field_table_and_report(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, spots: tuple[Path, Path, Path], more: tuple[str, ...]
) -> None:
    result, settings = tmp_path / "r.nc", [word for each in more for word in ("--set", each)]
    rows = {row["name"]: float(row["rad"]) for row in reconstruct(monkeypatch, spots, result, *settings)}
    field, table, report = tmp_path / "f.nc", tmp_path / "t.csv", tmp_path / "report.png"
    assert run(monkeypatch, "field", result, "--positions", "3", "--out", field, "--plot", tmp_path / "f.png") == 0
    with xr.open_dataset(field) as found:
        defocus = found["coefficient"].sel(mode=4).values
        np.testing.assert_allclose(defocus, rows["defocus"], rtol=0, atol=1e-9)
    assert run(monkeypatch, "export", result, "--to", "csv", "--out", table) == 0
    (row,) = csv.DictReader(table.read_text().splitlines())
    with xr.open_dataset(result) as stored:
        assert float(row["rms_0_0_rad"]) == float(stored["rms"].item())
        assert int(row["valid_lenslets"]) == int(stored["valid"].sum())
        if "coefficients" in stored:
            assert float(row["e_3_0_rad"]) == stored["coefficients"].values[3, 0]
    assert run(monkeypatch, "export", result, "--to", "psf", "--out", tmp_path / "psf.tif") == 2
    assert run(monkeypatch, "report", result, "--out", report) == 0
    assert_drawn(report)


@pytest.mark.slow
def test_comparison_is_the_difference(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, spots: tuple[Path, Path, Path]
) -> None:
    one, two, plot = tmp_path / "one.nc", tmp_path / "two.nc", tmp_path / "difference.png"
    reconstruct(monkeypatch, spots, one)
    with xr.open_dataset(one) as found:
        x, y = found["pupil_x"].values / RADIUS_M, found["pupil_y"].values[:, None] / RADIUS_M
        inside = np.hypot(x, y) <= 1
        tilt, coma = 0.7 * x + 0 * y, 0.2 * np.sqrt(8) * (3 * (x**2 + y**2) - 2) * y
        changed = found["wavefront"] - tilt - coma + 3.0
        found.assign(wavefront=changed).drop_vars(["coefficients", "coefficients_sigma"]).to_netcdf(two)
    capsys.readouterr()
    assert run(monkeypatch, "compare", one, two, "--plot", plot) == 0
    expected = (tilt + coma)[inside].std()
    shown = capsys.readouterr().out
    assert f"least {expected:.3f}, most {expected:.3f}, mean {expected:.3f} rad" in shown
    assert f"= {expected * NM:.4g} nm" in shown
    assert_drawn(plot)
    assert run(monkeypatch, "compare", one, two, "--remove", "tilt,coma") == 0
    assert "mean 0.000 rad" in capsys.readouterr().out
    other = tmp_path / "other.nc"
    with xr.open_dataset(two) as found:
        found.assign_attrs(removed="tilt, coma").to_netcdf(other)
    assert run(monkeypatch, "compare", one, other, "--remove", "tilt") == 0
    shown = capsys.readouterr().out
    assert "mean 0.000 rad" in shown
    assert "without tilt, coma" in shown
    other.unlink()
    reconstruct(monkeypatch, spots, other, "--set", "field.view_rows=2", "--set", "field.view_spacing_m=1e-4")
    capsys.readouterr()
    assert run(monkeypatch, "compare", one, other) == 2
    assert "has other views or lenslets, 2 x 1 x 12 x 12, than" in capsys.readouterr().err
    reconstruct(monkeypatch, spots, other, "--set", "sensor.wavelength_m=640e-9", "--overwrite")
    capsys.readouterr()
    assert run(monkeypatch, "compare", one, other) == 2
    assert "is at 640 nm" in capsys.readouterr().err
    assert run(monkeypatch, "compare", one, two, "--set", "registration.warp=affine") == 2
    assert "settings can be changed for recordings alone" in capsys.readouterr().err


def test_names_of_modes() -> None:
    assert modes_named(None) == frozenset()
    assert modes_named("tilt,defocus") == {2, 3, 4}
    assert modes_named(" Spherical ,astigmatism") == {5, 6, 11}
    for wrong in ("tip", "tilt,,defocus", "4"):
        with pytest.raises(InputError, match="none of tilt, defocus, astigmatism, coma, trefoil, spherical"):
            modes_named(wrong)

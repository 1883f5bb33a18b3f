"""The commands simulate and reconstruct: the files they write, and what they say of bad frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray as xr
from support.command_line import run
from support.paths import FOREIGN_FRAMES
from support.pictures import assert_drawn

from reconstruction.wavefront import rms

FRAMES = FOREIGN_FRAMES


def reconstruct_foreign(out: Path, *more: str | Path) -> tuple[str | Path, ...]:
    """Arguments that reconstruct the foreign frames."""
    reference = FRAMES / "square_reference.tif"
    return (
        "reconstruct",
        FRAMES / "square_frame.tif",
        *("--reference", reference, "--bench", FRAMES / "bench.toml", "--out", out, *more),
    )


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(
    ("changes", "figure_rad"),
    [
        (("registration.warp=affine", "reconstruction.pupil_modes=45"), 0.20),
        (("registration.warp=affine", "reconstruction.method=zonal"), 0.21),
    ],
)
def test_reconstruct_matches_truth(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    changes: tuple[str, ...],
    figure_rad: float,
) -> None:
    settings = [word for change in changes for word in ("--set", change)]
    out, picture = tmp_path / "deep" / "r.nc", tmp_path / "p.png"
    assert run(monkeypatch, *reconstruct_foreign(out, *settings, "--plot", picture)) == 0
    with xr.open_dataset(out) as result:
        residual = rms(result["wavefront"].to_numpy() - np.load(FRAMES / "truth.npz")["wavefront_rad"])
    assert residual.mean() < figure_rad
    assert "225 of 225 lenslets valid" in capsys.readouterr().out
    assert_drawn(picture)


@pytest.mark.slow
def test_reconstructing_simulated_frame_gives_truth(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "simulate", "--bench", small_toml, "--out", tmp_path) == 0
    names = {"dark.tif", "reference.tif", "frame.tif", "truth.nc"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert tifffile.imread(tmp_path / "frame.tif").dtype == np.uint16
    assert "light at the lenslets: " in capsys.readouterr().out
    files = ("--reference", tmp_path / "reference.tif", "--dark", tmp_path / "dark.tif", "--bench", small_toml)
    changed = ("--set", "registration.excluded=[[0,0]]", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", tmp_path / "frame.tif", *files, *changed) == 0
    assert " lenslets valid; 1 lost: excluded by hand; " in capsys.readouterr().out
    with xr.open_dataset(tmp_path / "r.nc") as result, xr.open_dataset(tmp_path / "truth.nc") as truth:
        assert result["wavefront"].dims == truth["wavefront"].dims == truth["light"].dims
        assert 0.001 < float(abs(truth["light"] - 1).mean()) < 0.2  # the screen gathers and spreads it
        assert truth.attrs["propagation_of_light"] == "from sample to lenslets"
        residual = rms((result["wavefront"] - truth["wavefront"]).to_numpy())
        assert residual.mean() < 0.1 * rms(truth["wavefront"].to_numpy()).mean()


def test_noise_free_images_are_float_photons(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_toml: Path) -> None:
    assert run(monkeypatch, "simulate", "--bench", small_toml, "--out", tmp_path, "--noise-free") == 0
    assert tifffile.imread(tmp_path / "frame.tif").dtype == np.float32
    assert tifffile.imread(tmp_path / "dark.tif").max() == 0


@pytest.mark.slow
@pytest.mark.long
def test_reconstruct_refine_limits_rounds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    files = (
        FRAMES / "square_frame.tif",
        "--reference",
        FRAMES / "square_reference.tif",
        "--bench",
        FRAMES / "bench.toml",
        "--set",
        "registration.warp=quartic",
        "--set",
        "reconstruction.pupil_modes=automatic",
    )
    assert run(monkeypatch, "reconstruct", *files, "--out", tmp_path / "r.nc", "--refine", "1") == 0
    assert "refined in 1 round," in capsys.readouterr().out.replace("\n", " ")  # of two without the limit
    with xr.open_dataset(tmp_path / "r.nc") as results:
        assert results.attrs["refinement_rounds"] == 1
        residual = results["wavefront"].to_numpy() - np.load(FRAMES / "truth.npz")["wavefront_rad"]
    assert residual.std(axis=(2, 3)).mean() < 0.012  # another simulator's frames


def _nan(image: np.ndarray) -> np.ndarray:
    image[3, 4] = np.nan
    return image


BAD_FRAMES = {
    "no such file": None,
    "cannot be read as TIFF, FITS, HDF5, MAT, NPY, NPZ, PNG, BMP or PGM": b"not an image",
    "has 100 x 512 pixels": lambda image: image[:100],
    "not finite": _nan,
    "3 x 512 x 512; one grey image": lambda image: np.stack([image] * 3),
    "is the light on": lambda image: np.random.default_rng(0).normal(0.01, 0.001, image.shape),
    "saturated": lambda image: np.minimum(image * 3e5, 65535).astype(np.uint16),
}


@pytest.mark.parametrize("sentence", BAD_FRAMES)
def test_bad_frame_exits_with_status_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, sentence: str
) -> None:
    path, make = tmp_path / "bad.tif", BAD_FRAMES[sentence]
    reference = FRAMES / "square_reference.tif"
    if isinstance(make, bytes):
        path.write_bytes(make)
    elif make is not None:
        image = make(tifffile.imread(FRAMES / "square_frame.tif"))
        tifffile.imwrite(path, image, photometric="minisblack")
        if image.dtype == np.uint16:  # the same camera, with an unsaturated reference
            reference = tmp_path / "reference.tif"
            tifffile.imwrite(reference, (tifffile.imread(FRAMES / "square_reference.tif") * 3e4).astype(np.uint16))
    out = tmp_path / "r.nc"
    command = ("--reference", reference, "--bench", FRAMES / "bench.toml", "--out", out)
    assert run(monkeypatch, "reconstruct", path, *command) == 2
    errors = capsys.readouterr().err
    assert errors.startswith(f"svwfs: {path}: ")
    assert sentence in errors
    assert errors.count("\n") == 1
    assert not out.exists()
    assert not list(tmp_path.glob(".*"))


def test_dark_reference_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "dark_reference.tif"
    tifffile.imwrite(path, np.random.default_rng(0).normal(500, 6, (512, 512)).astype(np.uint16))
    command = ("--reference", path, "--bench", FRAMES / "bench.toml", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", FRAMES / "square_frame.tif", *command) == 2
    assert capsys.readouterr().err.startswith(f"svwfs: {path}: the reference shows no light")


@pytest.mark.parametrize(("kind", "shift"), [(np.uint8, 8), (np.int16, 1)])
def test_frame_of_a_smaller_type_than_the_reference_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, kind: type, shift: int
) -> None:
    reference = (tifffile.imread(FRAMES / "square_reference.tif") * 1e5).clip(0, 60000).astype(np.uint16)
    tifffile.imwrite(tmp_path / "reference.tif", reference)
    tifffile.imwrite(tmp_path / "frame.tif", (reference >> shift).astype(kind))
    command = ("--reference", tmp_path / "reference.tif", "--bench", FRAMES / "bench.toml", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", tmp_path / "frame.tif", *command) == 2
    assert "values up to 60000: save both in the same form" in capsys.readouterr().err


@pytest.mark.parametrize("factor", [2.0**16, 1e7])
def test_frame_of_another_scale_than_the_reference_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, factor: float
) -> None:
    for name, peak in (("reference", 4e4), ("frame", 3e4 * factor)):
        image = tifffile.imread(FRAMES / f"square_{name}.tif").astype(np.float32)
        tifffile.imwrite(tmp_path / f"{name}.tif", image * np.float32(peak / image.max()))
    command = ("--reference", tmp_path / "reference.tif", "--bench", FRAMES / "bench.toml", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", tmp_path / "frame.tif", *command) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"svwfs: {tmp_path / 'reference.tif'}: holds float32 values up to ")
    assert said.endswith(": save both in the same form\n")


@pytest.mark.slow
@pytest.mark.parametrize(("setting", "is_told"), [("camera.rows=100", True), ("camera.exposure_s=0.1", False)])
def test_frame_of_another_size_than_the_bench_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, setting: str, is_told: bool
) -> None:
    assert run(monkeypatch, *reconstruct_foreign(tmp_path / "r.nc", "--set", setting)) == 0
    assert ("bench's camera 100 x 512: is this its bench?" in capsys.readouterr().err) == is_told


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize(("kind", "full"), [(np.uint16, 65535), (np.float32, 65535), (np.uint8, 255)])
def test_hot_pixel_in_the_reference_is_no_reason_to_refuse(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kind: type, full: int
) -> None:
    frame, reference = (tifffile.imread(FRAMES / f"square_{name}.tif") for name in ("frame", "reference"))
    scale = 0.8 * min(full, 60000) / reference.max()
    reference = np.rint(reference * scale).astype(kind)
    reference[3, 3] = full
    tifffile.imwrite(tmp_path / "reference.tif", reference)
    form = np.uint8 if kind is np.uint8 else np.uint16
    tifffile.imwrite(tmp_path / "frame.tif", np.rint(frame * scale).clip(0, full).astype(form))
    command = ("--reference", tmp_path / "reference.tif", "--bench", FRAMES / "bench.toml", "--out", tmp_path / "r.nc")
    assert run(monkeypatch, "reconstruct", tmp_path / "frame.tif", *command) == 0


@pytest.mark.slow
@pytest.mark.long
def test_unjudged_misfit_and_a_repeated_reference_are_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for warp, is_told in (("affine", False), ("translation", True)):
        command = reconstruct_foreign(tmp_path / f"{warp}.nc", "--set", f"registration.warp={warp}")
        assert run(monkeypatch, *command) == 0
        assert ("note: misfit is not checked: " in capsys.readouterr().out) == is_told
    command = reconstruct_foreign(tmp_path / "again.nc")
    assert run(monkeypatch, command[0], FRAMES / "square_reference.tif", *command[2:]) == 0
    assert "doubtful: frame and reference are the same image" in capsys.readouterr().out

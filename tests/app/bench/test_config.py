"""Bench files: values, round trips, and one-line errors that name the key."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support.paths import FOREIGN_FRAMES

from app.bench.bench_files import BenchError
from app.bench.config import load_bench, parse_bench, write_bench
from app.bench.presets import PRESETS
from app.errors import InputError
from drivers.genicam import GenicamSettings

MINIMAL = (FOREIGN_FRAMES / "bench.toml").read_text().replace("neglect_propagation = true\n", "")


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_survive_write_and_read(preset: str) -> None:
    bench = load_bench(preset)
    assert parse_bench(write_bench(bench), "again") == bench


def test_documented_bench_is_read() -> None:
    bench = parse_bench(MINIMAL, "bench.toml")
    assert bench.sensor.lenslet_focal_length_m == 46.7e-3
    assert bench.lattice is not None
    assert bench.lattice.pitch_px == 31.25
    assert (bench.registration.warp, bench.field.neglect_propagation) == ("quadratic", False)
    assert (bench.reconstruction.method, bench.reconstruction.pupil_modes) == ("modal", 66)


def test_byte_order_mark_of_notepad_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_bytes(b"\xef\xbb\xbf" + MINIMAL.encode())
    assert load_bench(path) == parse_bench(MINIMAL, "bench.toml")


def test_integer_is_accepted_as_float() -> None:
    assert parse_bench(MINIMAL.replace("center_x_px = 255.5", "center_x_px = 255"), "b").lattice is not None


def test_lattice_is_optional() -> None:
    start, end = MINIMAL.index("[lattice]"), MINIMAL.index("[field]")
    assert parse_bench(MINIMAL[:start] + MINIMAL[end:], "b").lattice is None


def test_arrangement_is_known_before_the_place_of_the_lattice() -> None:
    start, end = MINIMAL.index("[lattice]"), MINIMAL.index("[field]")
    bench = parse_bench(MINIMAL[:start] + '[lattice]\narrangement = "hexagonal"\n' + MINIMAL[end:], "b")
    assert (bench.sensor.arrangement, bench.lattice) == ("hexagonal", None)
    assert bench.design_lattice(512, 512).arrangement == "hexagonal"
    assert parse_bench(write_bench(bench), "again") == bench


def test_arrangement_belongs_to_sensor_and_lattice() -> None:
    bench = parse_bench(MINIMAL, "b", ("lattice.arrangement=hexagonal",))
    assert bench.lattice is not None
    assert (bench.sensor.arrangement, bench.lattice.arrangement) == ("hexagonal", "hexagonal")
    assert parse_bench(write_bench(bench), "again") == bench
    with pytest.raises(InputError, match=r"sensor\.arrangement is an unknown key; it is lattice\.arrangement"):
        parse_bench(MINIMAL, "b", ("sensor.arrangement=hexagonal",))
    with pytest.raises(ValueError, match=r'lattice\.arrangement = "square" is missing'):
        replace(bench, sensor=replace(bench.sensor, arrangement="square"))


FAULTS = {
    "unknown section": (
        "[sensor]",
        "[sensors]",
        "sensors is an unknown key: did you mean sensor? Known are sensor, field",
    ),
    "misspelt key": (
        "lenslet_rows",
        "lenslet_row",
        "sensor.lenslet_row is an unknown key: did you mean lenslet_rows? Known are lenslet_rows",
    ),
    "key of version 0.2": ("[registration]", "[registration]\nconserve_flux = true", "conserve_flux is an unknown key"),
    "missing key": ("wavelength_m = 462e-9\n", "", "sensor.wavelength_m is missing"),
    "unknown choice": ('"quadratic"', '"bent"', 'registration.warp must be one of "translation", "affine"'),
    "number for a choice": ('"quadratic"', "6", 'registration.warp must be one of "translation"'),
    "views outside the field": ("0.5e-3\n", "0.9e-3\n", "field.view_spacing_m places views outside"),
    "unknown arrangement": (
        "[lattice]",
        '[lattice]\narrangement = "triangular"',
        'lattice.arrangement must be one of "square", "hexagonal"',
    ),
    "broken TOML": ("[sensor]", "[sensor", "not valid TOML"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_invalid_bench_error_names_key(name: str) -> None:
    right, wrong, sentence = FAULTS[name]
    assert right in MINIMAL
    with pytest.raises(InputError) as fault:
        parse_bench(MINIMAL.replace(right, wrong, 1), "bench.toml")
    assert str(fault.value).startswith("bench.toml: ")
    assert sentence in str(fault.value)
    assert "\n" not in str(fault.value)


def test_unknown_driver_error_lists_drivers() -> None:
    with pytest.raises(InputError, match=r"b: camera\.driver = 'no such' is unknown; known are \"simulated\", "):
        parse_bench(MINIMAL + '\n[camera]\ndriver = "no such"\n', "b")


GENICAM = '\n[camera]\ndriver = "genicam"\nexposure_s = 0.01\n'
DC4100 = '\n[light]\ndriver = "thorlabs_dc4100"\nport = "/dev/ttyUSB0"\nlimit_a = 0.35\n'
BAD_DEVICES = {
    "a key of another driver": (
        GENICAM + "em_gain = 4.0\n" + DC4100,
        r"camera.em_gain is an unknown key: did you mean gain\? Known are driver, de",
    ),
    "a value it cannot have": (GENICAM + "binning = 0\n" + DC4100, "camera.binning must be 1"),
    "a number for a region": (GENICAM + "region = 3\n" + DC4100, "camera.region must be a section"),
    "a missing port": (GENICAM + DC4100.replace('port = "/dev/ttyUSB0"\n', ""), "light.port must be given"),
    "no light": (GENICAM, 'light.driver must be one of "thorlabs_dc4100", .* with camera.driver = "genicam"'),
    "a light that a simulated camera cannot see": (
        DC4100,
        'light.driver = "thorlabs_dc4100" cannot be used: a simulated camera sees no',
    ),
    "no section": ("", "camera must be a section"),
}


@pytest.mark.parametrize(("text", "sentence"), BAD_DEVICES.values(), ids=BAD_DEVICES)
def test_device_error_is_one_line(text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as refused:
        parse_bench((MINIMAL if text else "camera = 3\n" + MINIMAL) + text, "b")
    assert "\n" not in str(refused.value)


def test_real_bench_survives_write_and_read() -> None:
    bench = parse_bench(MINIMAL + GENICAM + DC4100, "b")
    assert (bench.camera.driver, bench.light.driver) == ("genicam", "thorlabs_dc4100")
    assert isinstance(bench.camera, GenicamSettings)
    assert bench.camera.exposure_s == 0.01
    assert parse_bench(write_bench(bench), "again") == bench
    changed = parse_bench(MINIMAL + GENICAM + DC4100, "b", ("camera.binning=2",)).camera
    assert isinstance(changed, GenicamSettings)
    assert changed.binning == 2


def test_overrides_change_settings() -> None:
    changes = ("registration.warp=affine", "reconstruction.pupil_modes=21", "simulation.seed = 4")
    bench = load_bench("live_demo", changes)
    assert bench.registration.warp == "affine"
    assert bench.reconstruction.pupil_modes == 21
    assert bench.simulation.seed == 4


@pytest.mark.parametrize("override", ["warp=affine", "registration.warp", "=", "sensor.wavelength_m.x=1", ""])
def test_malformed_override_is_refused(override: str) -> None:
    with pytest.raises(InputError, match=r"^setting '"):
        load_bench("live_demo", (override,))


def test_missing_and_binary_files_raise_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere.toml: no such file.*preset .live_demo"):
        load_bench(tmp_path / "nowhere.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        load_bench(tmp_path / "binary.toml")


def test_automatic_equals_omitted_setting() -> None:
    bench = load_bench("paper_simulation", ("registration.warp=automatic", "reconstruction.pupil_modes=automatic"))
    assert bench.registration.warp is None
    assert bench.reconstruction.pupil_modes is None
    assert parse_bench(write_bench(bench), "again") == bench


def test_too_many_lenslets_are_refused() -> None:
    with pytest.raises(InputError, match="lenslet_rows times lenslet_columns must be at most 40000"):
        load_bench("small_demo", ("sensor.lenslet_rows=1000", "sensor.lenslet_columns=1000"))


def test_deeply_nested_toml_is_refused() -> None:
    for brackets in ("[" * 20_000 + "]" * 20_000, "{a=" * 20_000):
        with pytest.raises(InputError, match="not valid TOML"):
            parse_bench(f"x = {brackets}", "deep.toml")


def test_setting_with_line_break_is_refused() -> None:
    with pytest.raises(InputError, match=r"write section\.key=value"):
        load_bench("small_demo", ("camera.rows=64\ncolumns=64",))


def test_nothing_in_the_working_directory_replaces_a_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "live_demo").mkdir()
    (tmp_path / "small_demo").write_text("[sensor]")
    assert load_bench("live_demo").sensor.lenslet_rows == 15
    assert load_bench("small_demo").is_simulated
    (tmp_path / "mine").write_text(write_bench(load_bench("small_demo")))
    with pytest.raises(InputError, match=r"mine: no such preset.*or the file as \./mine"):
        load_bench("mine")
    assert load_bench("./mine") == load_bench("small_demo")


def test_excluded_lenslets_are_written_and_must_exist() -> None:
    bench = parse_bench(MINIMAL, "b").with_excluded([(14, 3), (2, 5)], True)
    assert bench.registration.excluded == ((2, 5), (14, 3))
    assert parse_bench(write_bench(bench), "again") == bench
    assert bench.with_excluded([(2, 5), (0, 1)], None).registration.excluded == ((0, 1), (14, 3))
    assert bench.with_excluded([(2, 5), (0, 1)], True).registration.excluded == ((0, 1), (2, 5), (14, 3))
    assert bench.with_excluded([(2, 5), (0, 1)], False).registration.excluded == ((14, 3),)
    with pytest.raises(BenchError, match=r"no lenslet \[15, 3\] among 15 x 15"):
        parse_bench(MINIMAL.replace("[registration]", "[registration]\nexcluded = [[15, 3]]"), "b")

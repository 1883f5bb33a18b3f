"""Form of the bench's settings: fields from the dataclasses, texts to values, and the bench they make."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.bench.bench_files import BenchError
from app.bench.config import load_bench
from app.bench.device_kinds import DRIVERS
from app.bench.presets import PRESETS
from app.bench.settings_form import FormField, SettingsForm, fault_in_words
from app.errors import InputError
from drivers.device import DiscoveredDevice
from drivers.genicam import GenicamSettings
from drivers.light_source import ManualLightSettings


def fields(form: SettingsForm) -> dict[str, FormField]:
    return {field.path: field for section in form.sections() for field in section.fields}


@pytest.fixture
def form() -> SettingsForm:
    return SettingsForm.of(load_bench("live_demo"))


@pytest.mark.parametrize("preset", PRESETS)
def test_unchanged_form_gives_the_same_bench(preset: str) -> None:
    bench = load_bench(preset)
    form = SettingsForm.of(bench)
    for field in fields(form).values():
        form.set(field, field.text)
    assert form.bench() == bench


@pytest.mark.parametrize(
    ("path", "text"), [("sensor.wavelength_m", "500"), ("registration.excluded", "[[2, 3]]"), ("streams.port", "5000")]
)
def test_text_that_is_typed_back_restores_its_value(form: SettingsForm, path: str, text: str) -> None:
    before, field = form.bench(), fields(form)[path]
    form.set(field, text)
    assert form.bench() != before
    form.set(field, field.text)
    assert form.bench() == before


def test_fields_have_units_help_and_limits(form: SettingsForm) -> None:
    made = fields(form)
    pitch = made["sensor.lenslet_pitch_m"]
    assert (pitch.label, pitch.text, pitch.unit) == ("Lenslet pitch", "500", "\N{MICRO SIGN}m")
    assert pitch.help == "Distance between two lenslets, from the data sheet. Must be 1 ... 100000 \N{MICRO SIGN}m"
    assert (made["sensor.wavelength_m"].text, made["sensor.wavelength_m"].unit) == ("462", "nm")
    assert made["simulation.screen.samples"].help.endswith("Must be 8 ... 8192")
    assert made["simulation.screen.rms_rad"].label == "RMS"
    assert made["registration.threads"].help == "Number of threads, Gauss-Newton only. Must be 1 ... 64"
    assert made["registration.method"].help.endswith("too slow for live use")  # it has no limit
    assert made["field.shape"].choices == ("square", "circle")
    assert "range by amplifier and speed" in made["camera.exposure_s"].help
    assert made["streams.port"].is_optional
    assert made["light.driver"].choices == tuple(DRIVERS["light"])


@pytest.mark.parametrize(
    ("text", "pitch_m"),
    [("400", 400e-6), ("0.4 mm", 400e-6), ("0,4mm", 400e-6), ("400 um", 400e-6), ("4e2", 400e-6), ("0.0004 m", 400e-6)],
)
def test_lengths_are_read_in_any_unit(form: SettingsForm, text: str, pitch_m: float) -> None:
    form.set(fields(form)["sensor.lenslet_pitch_m"], text)
    form.set(fields(form)["lattice.pitch_px"], "25")
    assert form.bench().sensor.lenslet_pitch_m == pitch_m


@pytest.mark.parametrize(("text", "shown"), [("1e-3 m", "1 mm"), ("0.9 mm", "900 \N{MICRO SIGN}m")])
def test_length_is_shown_with_the_prefix_of_its_size(form: SettingsForm, text: str, shown: str) -> None:
    form.set(fields(form)["sensor.lenslet_pitch_m"], text)
    field = fields(form)["sensor.lenslet_pitch_m"]
    assert f"{field.text} {field.unit}" == shown


@pytest.mark.parametrize(
    ("path", "text", "sentence"),
    [
        ("sensor.lenslet_pitch_m", "4 s", "Lenslet pitch: type a number in \N{MICRO SIGN}m"),
        ("sensor.lenslet_pitch_m", "", "Lenslet pitch: type a number"),
        ("sensor.lenslet_rows", "3.5", "Lenslet rows: must be a whole number"),
        ("camera.em_read_noise_e", "[1, 2", "EM read noise: write it as in TOML"),
    ],
)
def test_unreadable_text_is_refused(form: SettingsForm, path: str, text: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence.replace("(", r"\(")):
        form.set(fields(form)[path], text)


@pytest.mark.parametrize(
    ("path", "text", "sentence"),
    [
        ("sensor.wavelength_m", "462 mm", "the settings: sensor.wavelength_m must be 1e-7 ... 2e-5"),
        ("field.view_spacing_m", "3 mm", "the settings: field.view_spacing_m places views outside"),
        ("lattice.pitch_px", "", "the settings: lattice.pitch_px is missing"),
        ("simulation.source.ellipse_ratio", "2", "the settings: simulation.source.ellipse_ratio must be"),
    ],
)
def test_wrong_bench_names_its_field(form: SettingsForm, path: str, text: str, sentence: str) -> None:
    form.set(fields(form)[path], text)
    with pytest.raises(BenchError) as refused:
        form.bench()
    assert str(refused.value).startswith(sentence)
    assert refused.value.fault is not None
    assert refused.value.fault.path == path


@pytest.mark.parametrize(
    ("path", "text", "words"),
    [
        ("sensor.lenslet_pitch_m", "-99999", "Lenslet pitch must be 1 ... 100000 \N{MICRO SIGN}m"),
        ("sensor.lenslet_pitch_m", "20", "Lenslet pitch must be at least 8 pixels"),
        ("sensor.wavelength_m", "462 mm", "Wavelength must be 100 ... 20000 nm"),
        ("field.view_spacing_m", "3 mm", "View spacing places views outside the field's Half width"),
        ("camera.exposure_s", "9 s", "Exposure must be 0.0139 ... 1 s with this amplifier and speed"),
        ("lattice.pitch_px", "", "Pitch is missing"),
        ("lattice.pitch_px", "20", "Pitch = 20 is far from Lenslet pitch (sensor) / Pixel pitch = 31.25"),
        ("simulation.seed", "-1", "Seed must be 0 ... 9223372036854775807"),
        ("camera.em_gain", "5000", "EM gain must be 1 ... 1200 (Maximum EM gain)"),
    ],
)
def test_error_has_labels_and_units_of_the_form(form: SettingsForm, path: str, text: str, words: str) -> None:
    shown = fields(form)  # their units do not follow what is typed
    form.set(shown[path], text)
    with pytest.raises(BenchError) as refused:
        form.bench()
    assert fault_in_words(refused.value, shown) == words


def test_new_bench_shows_data_of_its_example_only_as_examples() -> None:
    template = replace(load_bench("live_demo"), lattice=None)
    form = SettingsForm.of(template, is_new=True)
    template = replace(template, sensor=replace(template.sensor, lenslet_rows=None, lenslet_columns=None))
    made = fields(form)
    empty = {path for path, field in made.items() if field.example}
    assert empty == {
        *(f"sensor.lenslet_{name}" for name in ("pitch_m", "focal_length_m")),
        *("sensor.wavelength_m", "sensor.pixel_pitch_m", "field.collimator_focal_length_m", "field.half_width_m"),
    }
    assert not any(path.startswith("simulation") for path in made)
    assert (made["sensor.lenslet_pitch_m"].example, made["sensor.lenslet_pitch_m"].unit) == ("500", "\N{MICRO SIGN}m")
    for path in empty:
        assert not made[path].text
        form.set(made[path], made[path].example)  # also the same values are typed
        assert fields(form)[path].text == made[path].example
    assert form.bench() == template


def test_empty_lattice_is_found_in_the_reference(form: SettingsForm) -> None:
    for path in ("center_x_px", "center_y_px", "pitch_px", "rotation_rad"):
        form.set(fields(form)[f"lattice.{path}"], "")
    assert form.bench().lattice is None
    made = fields(SettingsForm.of(form.bench()))
    assert made["lattice.pitch_px"].text == ""


def test_connected_devices_replace_the_simulated_ones(form: SettingsForm) -> None:
    form.use_device(
        DiscoveredDevice(kind="camera", driver="genicam", description="Mako", settings={"device": "Mako 1"})
    )
    form.set(fields(form)["light.driver"], "manual")
    bench = form.bench()
    assert bench == replace(
        load_bench("live_demo"), camera=GenicamSettings(device="Mako 1"), light=ManualLightSettings()
    )
    form.set(fields(form)["camera.exposure_s"], "30")
    assert form.bench().camera == GenicamSettings(device="Mako 1", exposure_s=0.03)
    form.set(fields(form)["camera.exposure_s"], "")
    assert form.bench().camera == GenicamSettings(device="Mako 1")


@pytest.mark.parametrize("driver", DRIVERS["camera"])
def test_every_driver_has_a_form(form: SettingsForm, driver: str) -> None:
    form.set(fields(form)["camera.driver"], driver)
    assert fields(form)["camera.driver"].text == driver


def test_arrangement_alone_is_a_lattice_still_to_be_found() -> None:
    form = SettingsForm.of(load_bench("small_demo"))
    assert "sensor.arrangement" not in fields(form)
    form.set(fields(form)["lattice.arrangement"], "hexagonal")
    bench = form.bench()
    assert (bench.sensor.arrangement, bench.lattice) == ("hexagonal", None)
    assert fields(SettingsForm.of(bench))["lattice.arrangement"].text == "hexagonal"

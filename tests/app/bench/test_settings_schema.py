"""Limits of all settings, in the reader of benches and in the JSON schema for editors."""

from __future__ import annotations

import json
import math
import pickle
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jsonschema
import numpy as np
import pytest
import tomli_w
from support.command_line import run

from app.bench.bench_files import BenchError
from app.bench.config import bench_schema, load_bench, parse_bench
from app.bench.presets import PRESETS
from app.bench.settings_schema import allowed
from app.commands.schema import editor_schema
from drivers.dcam import DcamSettings
from drivers.serial_lights import DC4100Settings
from reconstruction.annotated_settings import SettingError, check
from simulated_devices.settings import SimulatedCameraSettings, SimulatedLightSettings

EDITOR = jsonschema.Draft7Validator(editor_schema())
BENCH = load_bench("small_demo")
NEEDED: dict[str, dict[str, Any]] = {  # beside what has a default
    "lattice": {"center_x_px": 40.0, "center_y_px": 40.0, "pitch_px": 31.25},
    "imaging": {"pixel_m": 1e-6},
    "linearity": {"quadratic": 0.0, "highest_counts": 1e4},
    "micro_manager": {"adapter": "A", "device": "D"},
    "recording": {"folder": "r"},
    "thorlabs_dc4100": {"port": "COM1"},
    "coolled": {"port": "COM1"},
}


def sections() -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Path, schema and sound values of each section; of camera and light for each driver."""

    def within(path: str, node: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
        driver = node["properties"].get("driver")
        chosen: dict[str, Any] = {"driver": driver["const"]} if driver else {}
        yield path, node, NEEDED.get(chosen.get("driver", path), {}) | chosen
        for name, each in node["properties"].items():
            if "properties" in each and "required" not in each:
                yield from within(f"{path}.{name}", each)

    for name, each in bench_schema()["properties"].items():
        for option in each.get("oneOf", [each]):
            yield from within(name, option)


def with_values(path: str, values: dict[str, Any]) -> dict[str, Any]:
    """The tree of a bench with these values; their order decides which fault is reported."""
    tree = tomllib.loads(PRESETS["small_demo"].read_text("utf-8"))
    *above, name = path.split(".")
    part = tree
    for each in above:
        part = part.setdefault(each, {})
    part[name] = (part.get(name, {}) if "driver" not in values else {}) | values
    return tree


def beyond(node: dict[str, Any]) -> Iterator[Any]:
    """Values of the right type just outside the limits of a setting."""
    if "enum" in node:
        yield "none of them"
    if node.get("minLength"):
        yield ""
    step = 1 if node.get("type") == "integer" else 1e-9
    if "maximum" in node:
        yield node["maximum"] + step * max(abs(node["maximum"]), 1)
    if "minimum" in node:
        yield node["minimum"] - step * max(abs(node["minimum"]), 1)
    if "exclusiveMinimum" in node:
        yield node["exclusiveMinimum"]
    if node.get("type") == "number":
        yield from (math.nan, math.inf)


LIMITS = [
    pytest.param(path, values, name, node, id=".".join((path, values.get("driver", ""), name)))
    for path, schema, values in sections()
    for name, node in schema["properties"].items()
    if node.get("type") != "boolean" and name != "driver"
]


@pytest.mark.parametrize(("path", "values", "name", "node"), LIMITS)
def test_value_beyond_a_limit_is_refused_with_its_key(
    path: str, values: dict[str, Any], name: str, node: dict[str, Any]
) -> None:
    one = node.get("items", node)
    for value in beyond(one):
        count = node.get("minItems", 1)
        tree = with_values(path, values | {name: [value] * count if node.get("type") == "array" else value})
        with pytest.raises(BenchError) as refused:
            parse_bench(tomli_w.dumps(tree), "b")
        is_number = not isinstance(value, float) or math.isfinite(value)
        limit = allowed(node) if is_number else "must be a finite number"
        assert str(refused.value).startswith(f"b: {path}.{name} {limit}")
        assert not (is_number and EDITOR.is_valid(tree))


@pytest.mark.parametrize(("path", "values", "name", "node"), LIMITS)
def test_value_of_another_type_is_refused_with_its_key(
    path: str, values: dict[str, Any], name: str, node: dict[str, Any]
) -> None:
    kinds = {"integer": (True, 2.5, "2"), "number": (True, "2", [1.0]), "string": (1, "a\0b", ["a"])}
    for value in kinds.get(node.get("type", ""), (True, "a")):
        with pytest.raises(BenchError, match=rf"^b: {path}\.{name} must be ") as refused:
            parse_bench(tomli_w.dumps(with_values(path, values | {name: value})), "b")
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("node", "unit", "factor", "sentence"),
    [
        ({"minimum": 1, "maximum": 64}, "", 1.0, "must be 1 ... 64"),
        ({"minimum": 1, "maximum": 2, "type": "integer"}, "", 1.0, "must be 1 or 2"),
        ({"minimum": 1e-7, "maximum": 2e-5}, "", 1.0, "must be 1e-7 ... 2e-5"),
        ({"minimum": 1e-7, "maximum": 2e-5}, "nm", 1e-9, "must be 100 ... 20000 nm"),
        ({"exclusiveMinimum": 0}, "ms", 1e-3, "must be positive"),
        ({"minimum": 0}, "ms", 1e-3, "must be 0 or positive"),
        ({"minimum": 0.5}, "ms", 1e-3, "must be at least 500 ms"),
        ({"exclusiveMinimum": 0, "maximum": 100}, "A", 1.0, "must be above 0 and at most 100 A"),
        ({"type": "number"}, "A", 1.0, ""),
    ],
)
def test_limit_in_words(node: dict[str, Any], unit: str, factor: float, sentence: str) -> None:
    assert allowed(node, unit, factor) == sentence


def test_numbers_of_devices_have_an_upper_limit() -> None:
    """A typing error is stopped before the device opens."""
    for section in ("camera", "light"):
        for option in bench_schema()["properties"][section]["oneOf"]:
            for name, node in option["properties"].items():
                assert node.get("items", node).get("type") not in {"integer", "number"} or "maximum" in node.get(
                    "items", node
                ), name


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (lambda: SimulatedCameraSettings(em_gain=301.0, maximum_em_gain=300.0), "1 ... 300 (maximum_em_gain)"),
        (lambda: SimulatedCameraSettings(exposure_s=2.0), "0.0139 ... 1 s with this amplifier and speed"),
        (lambda: SimulatedLightSettings(current_a=3.0, maximum_current_a=2.0), "0 ... 2 A (maximum_current_a)"),
    ],
)
def test_limit_of_another_setting_is_told_as_a_number(settings: Any, sentence: str) -> None:
    with pytest.raises(SettingError) as told:
        settings()
    assert str(told.value).endswith(f"must be {sentence}")
    copy = pickle.loads(pickle.dumps(told.value))  # noqa: S301 - our own: errors cross processes
    assert (str(copy), copy.path) == (str(told.value), told.value.path)


def test_bench_made_in_python_is_checked() -> None:
    int_of_numpy: Any = np.int64(0)
    with pytest.raises(SettingError, match=r"^camera\.binning must be 1 \.\.\. 16$"):
        replace(BENCH, camera=DcamSettings(binning=0), light=DC4100Settings(port="COM1"))
    with pytest.raises(SettingError, match=r"^light\.port must be given"):
        replace(BENCH, camera=DcamSettings(), light=DC4100Settings())
    with pytest.raises(SettingError, match=r"^sensor\.wavelength_m must be a finite number$"):
        replace(BENCH, sensor=replace(BENCH.sensor, wavelength_m=math.nan))
    with pytest.raises(SettingError, match=r"^registration\.threads must be 1 \.\.\. 64$"):
        replace(BENCH, registration=replace(BENCH.registration, threads=int_of_numpy))
    own: Any = "my_method"
    assert replace(BENCH, registration=replace(BENCH.registration, method=own)).registration.method is own


def test_contradiction_in_a_part_is_named() -> None:
    screen = replace(BENCH.simulation.screen)
    object.__setattr__(screen, "pv_rad", 1e-3)
    with pytest.raises(SettingError, match=r"^screen\.pv_rad must be more than"):
        check(replace(BENCH.simulation, screen=screen))


BAD = {
    "a date": ("sensor.lenslet_rows=1979-05-27", "sensor.lenslet_rows must be a whole number"),
    "a huge number": (f"streams.port=0x{'f' * 5000}", "streams.port must be 1 ... 65535"),
    "a number for a driver": ("camera.driver=3", "camera.driver = 3 is unknown; known are"),
    "a list for a driver": ("camera.driver=[]", "camera.driver = [] is unknown; known are"),
    "a section for a number": ("sensor.lenslet_rows={a=1}", "sensor.lenslet_rows must be a whole number"),
    "a deep list": (f"sensor.lenslet_rows={'[' * 300}{']' * 300}", "sensor is nested too deeply"),
    "a short list": ("camera.em_read_noise_e=[1, 2]", "camera.em_read_noise_e must be a list of 3"),
    "a long list": ("camera.em_read_noise_e=[1, 2, 3, 4]", "camera.em_read_noise_e must be a list of 3"),
    "a short pair": ("registration.excluded=[[1, 2], [3]]", "registration.excluded must be a list of 2"),
    "no list": ("registration.excluded=3", "registration.excluded must be a list"),
    "a null character": ('camera.driver="dcam\\u0000"', "camera.driver = "),
}


@pytest.mark.parametrize(("setting", "sentence"), BAD.values(), ids=BAD)
def test_bad_value_is_one_sentence(setting: str, sentence: str) -> None:
    with pytest.raises(BenchError) as refused:
        load_bench("small_demo", (setting,))
    assert str(refused.value).startswith(f"small_demo: {sentence}")
    assert "\n" not in str(refused.value)


def test_unknown_key_is_reported_before_what_it_lacks() -> None:
    with pytest.raises(
        BenchError, match=r"^b: sensor\.lenslet_row is an unknown key: did you mean lenslet_rows\?"
    ) as refused:
        parse_bench(PRESETS["small_demo"].read_text("utf-8").replace("lenslet_rows", "lenslet_row"), "b")
    assert "arrangement" not in str(refused.value)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_name_the_printed_schema_and_obey_it(
    preset: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "schema") == 0
    printed = json.loads(capsys.readouterr().out)
    jsonschema.Draft7Validator.check_schema(printed)
    text = PRESETS[preset].read_text("utf-8")
    jsonschema.Draft7Validator(printed).validate(tomllib.loads(text))
    assert text.startswith("#:schema bench.schema.json\n")


@pytest.mark.parametrize(
    ("path", "values", "is_valid"),
    [
        ("registration", {"warp": "automatic"}, True),
        ("reconstruction", {"pupil_modes": "automatic"}, True),
        ("reconstruction", {"pupil_modes": "many"}, False),
        ("camera", {"rows": 64}, True),  # simulated, if no driver is named
        ("camera", {"driver": "dcam", "rows": 64}, False),
        ("camera", {"driver": "dcam"}, True),
        ("light", {"driver": "none"}, False),
        ("sensor", {"arrangement": "square"}, False),
        ("sensor", {"lenslet_row": 3}, False),
        ("sensors", {}, False),
        ("streams", {"port": 0.5}, False),
    ],
)
def test_schema_accepts_what_a_bench_accepts(path: str, values: dict[str, Any], is_valid: bool) -> None:
    tree = with_values(path, values)
    assert EDITOR.is_valid(tree) == is_valid
    if path != "camera" or is_valid is False:
        assert is_read(tree) == is_valid


def test_schema_knows_a_lattice_of_which_only_the_arrangement_is_given() -> None:
    tree = with_values("lattice", {})
    for lattice, is_valid in (
        ({"arrangement": "hexagonal"}, True),
        ({"arrangement": "hexagonal", "pitch_px": 31.0}, False),
        ({"arrangement": "round"}, False),
        ({}, False),
    ):
        assert EDITOR.is_valid(tree | {"lattice": lattice}) == is_valid == is_read(tree | {"lattice": lattice})


def is_read(tree: dict[str, Any]) -> bool:
    try:
        parse_bench(tomli_w.dumps(tree), "b")
    except BenchError:
        return False
    return True


def test_schema_describes_limits_defaults_and_choices() -> None:
    settings = EDITOR.schema["properties"]["registration"]["properties"]
    assert settings["threads"]["description"] == "Number of threads, Gauss-Newton only"
    assert (settings["threads"]["minimum"], settings["threads"]["maximum"]) == (1, 64)
    assert settings["method"]["default"] == "automatic"
    assert "centroids" in settings["method"]["enum"]

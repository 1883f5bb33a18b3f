"""Settings classes: their annotations are the limits, for any value."""

from __future__ import annotations

import math
import pickle
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, get_type_hints

import pytest
from annotated_types import Ge, Gt, Interval, Le, MinLen
from hypothesis import given
from hypothesis import strategies as st
from typing_extensions import Doc

from app.bench.config import StreamSettings, load_bench
from app.bench.device_kinds import RecordingSettings
from drivers.dcam import DcamSettings
from drivers.genicam import GenicamSettings
from drivers.manual_light import ManualLightSettings
from drivers.micro_manager import MicroManagerSettings
from drivers.serial_lights import CoolLEDSettings, DC4100Settings
from drivers.usb_lights import DC2200Settings
from reconstruction.annotated_settings import Checked, Limit, Setting, SettingError, check, settings_of
from reconstruction.deconvolution.imaging import Imaging
from reconstruction.geometry import nominal_lattice

BENCH = load_bench("live_demo")


def described(base: object) -> tuple[Setting, ...]:
    cls: type = type(base)
    return settings_of(cls)


BASES: list[Any] = [
    BENCH.sensor,
    nominal_lattice(BENCH.sensor, 512, 512),
    BENCH.field,
    BENCH.registration,
    BENCH.reconstruction,
    BENCH.camera,
    BENCH.light,
    BENCH.simulation,
    BENCH.simulation.screen,
    BENCH.simulation.source,
    StreamSettings(),
    Imaging(pixel_m=1e-6),
    RecordingSettings(folder="r"),
    DcamSettings(),
    GenicamSettings(),
    MicroManagerSettings(adapter="A", device="D"),
    DC4100Settings(port="COM1"),
    DC2200Settings(),
    CoolLEDSettings(port="COM1"),
    ManualLightSettings(),
]
LIMITED = [
    pytest.param(base, settings, id=type(base).__name__)
    for base in BASES
    if (settings := [setting for setting in described(base) if setting.limit(base) is not None])
]


def limit_of(base: Any, setting: Setting) -> Limit:
    limit = setting.limit(base)
    assert limit is not None
    return limit


@pytest.mark.parametrize("base", BASES, ids=lambda base: type(base).__name__)
def test_good_settings_pass(base: Any) -> None:
    check(base)


@pytest.mark.parametrize(("base", "settings"), LIMITED)
@given(data=st.data())
def test_values_of_the_annotated_type_are_allowed(base: Any, settings: list[Setting], data: st.DataObject) -> None:
    """Hypothesis reads the annotations itself; it does not know that limits hold for the numbers of a tuple."""
    setting = data.draw(st.sampled_from([one for one in settings if not isinstance(one.default, tuple)]))
    hint = get_type_hints(type(base), include_extras=True)[setting.name]
    value = data.draw(st.from_type(hint).filter(lambda one: not isinstance(one, float) or math.isfinite(one)))
    if setting.name != "exposure_s" or base is not BENCH.camera:  # whose limit follows from others
        assert value is None or limit_of(base, setting).allows(value)


def outside(limit: Limit) -> st.SearchStrategy[Any]:
    """Values beyond a limit."""
    if limit.choices:
        return st.text().filter(lambda text: text not in limit.choices)
    if limit.min_length:
        return st.just("")
    numbers: Any = st.integers if limit.is_whole else st.floats
    beyond = [] if limit.is_whole else [st.sampled_from([math.nan, math.inf, -math.inf])]
    if limit.le is not None:
        beyond.append(numbers(min_value=limit.le).filter(lambda number: number > limit.le))
    if limit.ge is not None:
        beyond.append(numbers(max_value=limit.ge).filter(lambda number: number < limit.ge))
    if limit.gt is not None:
        beyond.append(numbers(max_value=limit.gt))
    return st.one_of(beyond)


@pytest.mark.parametrize(("base", "settings"), LIMITED)
@given(data=st.data())
def test_values_beyond_a_limit_are_refused_with_its_key_and_words(
    base: Any, settings: list[Setting], data: st.DataObject
) -> None:
    setting = data.draw(st.sampled_from(settings))
    limit = limit_of(base, setting)
    value = data.draw(outside(limit))
    if isinstance(setting.default, tuple):
        value = (*setting.default[1:], value)
    with pytest.raises(SettingError) as refused:
        check(replace(base, **{setting.name: value}))
    assert (refused.value.path, refused.value.limit) == (setting.name, limit)
    assert str(refused.value) == f"{setting.name} {limit.words()}"


@dataclass(frozen=True, kw_only=True)
class Part(Checked):
    length_m: Annotated[float, Interval(gt=0, le=1e-3), Doc("Of the part")] = 1e-4


@dataclass(frozen=True, kw_only=True)
class Whole:
    """Does not check itself."""

    count: Annotated[int, Interval(ge=1, le=2)]
    shape: Literal["round", "square"] | None = None
    name: Annotated[str, MinLen(1)] = "x"
    sides_m: Annotated[tuple[float, float], Ge(1e-7)] = (1.0, 2.0)
    part: Part = Part()


@pytest.mark.parametrize(
    ("words", "unit", "factor", "sentence"),
    [
        ((Interval(ge=1, le=64),), "", 1.0, "must be 1 ... 64"),
        ((Interval(ge=1e-7, le=2e-5),), "", 1.0, "must be 1e-7 ... 2e-5"),
        ((Interval(ge=1e-7, le=2e-5),), "nm", 1e-9, "must be 100 ... 20000 nm"),
        ((Gt(0),), "ms", 1e-3, "must be positive"),
        ((Ge(0),), "ms", 1e-3, "must be 0 or positive"),
        ((Ge(0.5),), "ms", 1e-3, "must be at least 500 ms"),
        ((Gt(0), Le(100)), "A", 1.0, "must be above 0 and at most 100 A"),
        ((), "A", 1.0, "must be finite"),
    ],
)
def test_limit_in_words(words: tuple[Any, ...], unit: str, factor: float, sentence: str) -> None:
    @dataclass
    class One:
        value: Annotated[(float, *words, Doc("help"))] = 1.0

    One.__annotations__["value"] = Annotated[(float, *words, Doc("help"))]
    (setting,) = settings_of(One)
    assert setting.help == "help"
    assert limit_of(One(), setting).words(unit, factor) == sentence


def test_description_names_type_default_and_choices() -> None:
    count, shape, name, sides, part = settings_of(Whole)
    assert (count.kind, count.is_optional, limit_of(Whole(count=1), count).words()) == (int, False, "must be 1 or 2")
    assert (shape.is_optional, shape.default) == (True, None)
    assert limit_of(Whole(count=1), shape).choices == ("round", "square")
    assert limit_of(Whole(count=1), name).words() == "must not be empty"
    assert sides.default == (1.0, 2.0)
    assert part.kind is Part


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"count": 3}, "count must be 1 or 2"),
        ({"shape": "flat"}, 'shape must be one of "round", "square"'),
        ({"name": ""}, "name must not be empty"),
        ({"sides_m": (1.0, -1.0)}, "sides_m must be at least 1e-7"),
    ],
)
def test_wrong_setting_is_named(wrong: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SettingError) as refused:
        check(Whole(**{"count": 1, **wrong}))
    assert str(refused.value) == sentence


def test_part_checks_itself_and_the_whole_checks_its_parts() -> None:
    with pytest.raises(SettingError, match=r"^length_m must be above 0 and at most 0\.001$"):
        Part(length_m=0.0)
    broken = Part()
    object.__setattr__(broken, "length_m", 1.0)
    with pytest.raises(SettingError, match=r"^part\.length_m must be") as refused:
        check(Whole(count=1, part=broken))
    copy = pickle.loads(pickle.dumps(refused.value))  # noqa: S301 - our own: errors cross processes
    assert (str(copy), copy.path, copy.limit) == (str(refused.value), "part.length_m", refused.value.limit)


def test_bench_checks_devices_that_do_not_check_themselves() -> None:
    with pytest.raises(SettingError, match=r"^camera\.binning must be 1 \.\.\. 16$"):
        replace(BENCH, camera=DcamSettings(binning=0), light=DC4100Settings(port="COM1"))
    with pytest.raises(SettingError, match=r"^light\.port must be given"):
        replace(BENCH, camera=DcamSettings(), light=DC4100Settings())

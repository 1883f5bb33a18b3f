"""The line of a fault in a bench file."""

from __future__ import annotations

import pytest
from support.paths import FOREIGN_FRAMES

from app.bench.bench_files import BenchError
from app.bench.config import load_bench, parse_bench
from app.errors import InputError

LINES = (FOREIGN_FRAMES / "bench.toml").read_text().splitlines()
# what stands in the line, what replaces it, and what stands in the line that is named if it is another
FAULTS = {
    "wrong type": ("lenslet_rows = ", 'lenslet_rows = "15"', ""),
    "out of range": ("wavelength_m = ", "  wavelength_m  =  462", ""),
    "unknown key": ("lenslet_columns = ", "lenslet_column = 15", ""),
    "unknown choice": ("warp = ", 'warp = "bent" # comment', ""),
    "missing key": ("lenslet_pitch_m = ", "", "[sensor]"),
    "unknown section": ("[sensor]", "[ sensors ]", ""),
    "two sections": ("pitch_px = ", "pitch_px = 99.0", ""),
    "syntax": ("half_width_m = ", "half_width_m = = 1", ""),
    "views": ("view_spacing_m = ", "view_spacing_m = 0.9e-3", ""),
}


@pytest.mark.parametrize("name", FAULTS)
def test_fault_names_its_line(name: str) -> None:
    begin, wrong, elsewhere = FAULTS[name]
    index = next(index for index, line in enumerate(LINES) if line.startswith(begin))
    lines = [*LINES[:index], wrong, *LINES[index + 1 :]]
    with pytest.raises(BenchError) as fault:
        parse_bench("\n".join(lines), "bench.toml")
    assert fault.value.line == 1 + (lines.index(elsewhere) if elsewhere else index)


def test_fault_of_two_sections_names_the_one_that_exists() -> None:
    lines = [*LINES, "[camera]", 'driver = "genicam"']
    with pytest.raises(BenchError, match=r"light\.driver must be one of") as fault:
        parse_bench("\n".join(lines), "bench.toml")
    assert fault.value.line is None  # there is no section [light]


def test_unfinished_file_names_its_last_line() -> None:
    with pytest.raises(BenchError) as fault:
        parse_bench("\n".join([*LINES, "[camera"]), "bench.toml")
    assert fault.value.line == len(LINES) + 1


def test_fault_of_an_override_names_no_line() -> None:
    with pytest.raises(BenchError) as fault:
        parse_bench("\n".join(LINES), "bench.toml", ("sensor.lenslet_rows=0",))
    assert fault.value.line is None


@pytest.mark.parametrize(
    ("setting", "allowed"),
    [
        ("registration.warp=bent", 'one of "translation", "affine", "quadratic", "cubic", "quartic", or "automatic"'),
        ("reconstruction.pupil_modes=0", '3 ... 1000, or "automatic"'),
        ("reconstruction.pupil_modes=many", 'a whole number, or "automatic"'),
    ],
)
def test_sentence_names_automatic_where_it_is_allowed(setting: str, allowed: str) -> None:
    key, _, _ = setting.partition("=")
    with pytest.raises(BenchError) as fault:
        load_bench("small_demo", (setting,))
    assert str(fault.value) == f"small_demo: {key} must be {allowed}"
    load_bench("small_demo", (f"{key}=automatic",))


def test_integer_of_too_many_digits_is_one_sentence() -> None:
    """Python refuses to read more than 4300 digits, with another error than TOML's."""
    number = "9" * 5000
    with pytest.raises(InputError, match=r"bench: .*4300"):
        parse_bench(f"[sensor]\nlenslet_rows = {number}\n", "bench")
    with pytest.raises(InputError, match="lenslet_rows"):
        load_bench("small_demo", (f"sensor.lenslet_rows={number}",))

"""From a reference to the bench with its lattice in force: what `svwfs calibrate` does."""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from app.bench.config import Bench, parse_bench, write_bench
from app.bench.presets import PRESETS
from app.errors import InputError
from app.files import atomic_write, read_image
from app.measurement.bench_reconstructor import full_scale_of
from app.progress import Progress
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey, survey

_NOTEWORTHY = 0.005  # of the pitch, by which the design is off
_LATTICE_SECTION = re.compile(r"^\[lattice\][^\n]*\n(?:(?!\[)[^\n]*\n)*", re.MULTILINE)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What a reference shows."""

    reference: NDArray[Any]  # (row, column), counts
    design: Bench  # as it was given
    bench: Bench  # the same with the lattice that was found
    survey: Survey


def calibrate(reference: Path, *, dark: Path | None, bench: Bench, progress: Progress = lambda *_: None) -> Found:
    """Find the lattice in a reference from image files; whatever is wrong with them is an `InputError` that says so."""
    image = read_image(reference)
    dark_image = None if dark is None else read_image(dark)
    try:
        most = full_scale_of(image, bench.camera_model.bits)
        found = survey(image, bench.sensor, dark=dark_image, full_scale=most, progress=progress)
        return Found(image, bench, dataclasses.replace(bench, lattice=_rounded(found.lattice)), found)
    except ReconstructionError as error:
        raise InputError(f"{dark if error.image == 'dark' else reference}: {error}") from error
    except ValueError as error:  # a bench refuses a pitch far from the designed one
        raise InputError(f"{reference}: {error}; check the sensor's lenslet_pitch_m and pixel_pitch_m") from error


def _rounded(lattice: Lattice) -> Lattice:
    """Leave out the decimals that mean nothing."""
    values = dataclasses.asdict(lattice)
    return Lattice(**{name: round(value, 9 if name.endswith("_rad") else 6) + 0.0 for name, value in values.items()})


def findings(found: Found) -> list[str]:
    """What was found, in lines of text."""
    lattice, seen = found.survey.lattice, found.survey
    rows, columns = seen.illuminated.shape
    return [
        f"pitch        {lattice.pitch_px:.4f} px",
        f"rotation     {lattice.rotation_rad * 1e3:+z.3f} mrad ({math.degrees(lattice.rotation_rad):+z.3f} degrees)",
        f"centre       x {lattice.center_x_px:.3f} px, y {lattice.center_y_px:.3f} px",
        f"lenslets     {seen.rows} x {seen.columns} lit and whole on the frame; {rows} x {columns} are used",
        f"illuminated  {seen.illuminated.sum()} of {rows * columns} ({100 * seen.illuminated_fraction:.1f} %)",
        f"quality      light {seen.residual_px:.3f} px RMS beside the lattice, alike to {100 * seen.likeness:.0f} %",
    ]


def differences(found: Found) -> list[str]:
    """What differs from the bench as it was given, a sentence each."""
    sensor, seen, before = found.design.sensor, found.survey, found.design.lattice
    said = []
    off = seen.lattice.pitch_px / sensor.lenslet_pitch_px - 1
    if abs(off) > _NOTEWORTHY:
        said.append(f"the pitch is {100 * off:+.1f} % off the design, {sensor.lenslet_pitch_px:.4f} px")
    if (seen.rows, seen.columns) != (sensor.lenslet_rows, sensor.lenslet_columns):
        said.append(
            f"the frame shows {seen.rows} x {seen.columns} whole lenslets, the bench has"
            f" lenslet_rows = {sensor.lenslet_rows}, lenslet_columns = {sensor.lenslet_columns}"
        )
    if before is not None:
        moved_px = math.hypot(
            seen.lattice.center_x_px - before.center_x_px, seen.lattice.center_y_px - before.center_y_px
        )
        turned_mrad = (seen.lattice.rotation_rad - before.rotation_rad) * 1e3
        said.append(
            f"the bench's own lattice lies {moved_px:.3f} px away; the one found is turned from it by"
            f" {turned_mrad:+z.3f} mrad, and its pitch differs by {seen.lattice.pitch_px - before.pitch_px:+z.4f} px"
        )
    return said


def as_numbers(found: Found) -> dict[str, float | int | list[str]]:
    """The same for another program: names as in the bench's TOML."""
    seen = found.survey
    return {
        **dataclasses.asdict(seen.lattice),
        "whole_rows": seen.rows,
        "whole_columns": seen.columns,
        "lenslets": int(seen.illuminated.size),
        "illuminated": int(seen.illuminated.sum()),
        "residual_px": seen.residual_px,
        "likeness": seen.likeness,
        "differences": differences(found),
    }


def check_out(path: Path, *, overwrite: bool) -> None:
    """Raise `InputError`, before any work is done, if a bench that is already there would be lost."""
    if path.exists() and not overwrite:
        raise InputError(f"{path}: is there already; give another name, or --overwrite to replace it")


def write_calibrated(found: Found, source: str, path: Path) -> None:
    """Write the bench with its lattice; `source` is the TOML file or preset it came from, whose comments are kept."""
    origin = Path(source) if Path(source).exists() else PRESETS[source]
    text = bench_text(origin.read_text("utf-8"), found.bench)
    with atomic_write(path) as temporary:
        temporary.write_text(text, "utf-8")


def bench_text(text: str, bench: Bench) -> str:
    """Put the lattice of `bench` into the TOML text that the rest of it came from, comments and all.

    Where that does not give the same bench, because settings were changed since or the text says it in another way,
    the bench is written anew.
    """
    section = _lattice_section(bench)
    edited, count = _LATTICE_SECTION.subn(lambda _: section, text, count=1)
    if not count:
        edited = f"{text.rstrip()}\n\n{section}"
    try:
        same = parse_bench(edited, "the calibrated bench") == bench
    except InputError:
        same = False
    return edited if same else write_bench(bench)


def _lattice_section(bench: Bench) -> str:
    lattice = bench.lattice
    values = {} if lattice is None else dataclasses.asdict(lattice)
    lines = [f"{name} = {value!r}" for name, value in values.items()]
    return "\n".join(["[lattice] # found by svwfs calibrate", *lines]) + "\n\n"

"""`svwfs calibrate`: find the lattice in a reference, or measure the camera's nonlinearity."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.commands import options, terminal
from app.errors import InputError, RunError
from app.files import write_whole
from app.images import IMAGE_FORMATS
from app.measurement.averages import EXPOSURE_FRAMES, LEAST_EXPOSURE_FRAMES
from app.progress import Progress

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from app.bench.config import Bench
    from app.measurement.mask_scale import MaskScale
    from reconstruction.frame.linearity_fit import MeasuredLinearity
    from reconstruction.geometry import Lattice
    from reconstruction.lattice.search import Survey

_NOTEWORTHY = 0.005  # relative deviation of the pitch from the design that is reported


def calibrate(
    reference: Annotated[Path | None, typer.Argument(help=f"Frame without the sample: {IMAGE_FORMATS}.")] = None,
    *,
    bench: options.Bench,
    out: Annotated[Path | None, typer.Option(help="Bench TOML file to write, with what was found.")] = None,
    dark: Annotated[Path | None, typer.Option(help="Frame with the light off.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture of the frame with its lenslets: PNG, PDF or SVG.")] = None,
    linearity: Annotated[
        bool, typer.Option("--linearity", help="Measure the camera's nonlinearity with the bench's devices instead.")
    ] = False,
    average: Annotated[
        int | None, options.average_option("each exposure of --linearity", EXPOSURE_FRAMES, LEAST_EXPOSURE_FRAMES)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the numbers as JSON.")] = False,
    overwrite: options.Overwrite = False,
    trust_library: options.Trust = False,
    setting: options.Set = None,
) -> None:
    """Find the lenslet lattice in a reference frame, or measure the camera's nonlinearity.

    The result is pitch, rotation, centre, the lenslets with light, and the size of the mask's image: the scale of every
    wavefront. Check the picture of --plot: every subimage should lie in the middle of its cell. Without --out the
    result is only printed.

    With --linearity it needs no reference: it takes darks, then exposures without the sample from short to long and
    back, twice, and restores the devices. The bench of --out corrects every frame, its dark subtracted.

    Example: svwfs calibrate reference.tif --bench paper_experiment --out bench.toml --plot lattice.png

    Example: svwfs calibrate --linearity --bench small_demo --set camera.nonlinearity=0.04 --out linear.toml
    """
    loaded = options.load(bench, setting)
    if linearity:
        if not all(given is None for given in (reference, dark, plot)):
            raise InputError("--linearity takes its own exposures: leave reference, --dark and --plot out")
        options.check_files(out, reads=options.files_of_bench(bench, loaded), suffixes=(".toml",), overwrite=overwrite)
        terminal.confirm_libraries(loaded, is_trusted=trust_library)
        with terminal.progress_bar() as progress:
            measured = find_linearity(loaded, average, progress)
        if out is not None:
            write_found(dataclasses.replace(loaded, linearity=measured.linearity), "linearity", bench, out)
        typer.echo(json.dumps(dataclasses.asdict(measured)) if as_json else "\n".join(linearity_summary(measured)))
        return
    if reference is None:
        raise InputError("give the reference frame; only --linearity takes its own")
    if average is not None:
        raise InputError("--average belongs to --linearity")
    from app.results.figures import lattice_figure

    reads = (*options.files_of_images(reference, dark), *options.files_of_bench(bench, loaded))
    options.check_files(out, reads=reads, suffixes=(".toml",), plot=plot, overwrite=overwrite)
    with terminal.progress_bar() as progress:
        calibrated = calibrate_bench(reference, dark=dark, bench=loaded, progress=progress)
    options.draw(plot, lambda: lattice_figure(calibrated.reference, calibrated.survey))
    if out is not None:
        write_found(calibrated.bench, "lattice", bench, out)
    if as_json:
        typer.echo(json.dumps(as_numbers(calibrated)))
        return
    typer.echo("\n".join(summary(calibrated)))
    for difference in differences(calibrated):
        terminal.remind(f"note: {difference}")


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedBench:
    """A bench with the lattice found in a reference."""

    reference: NDArray[Any]  # (row, column), counts
    design: Bench  # as given
    bench: Bench  # with the lattice found
    survey: Survey
    mask_scale: MaskScale | None  # None: the reference does not show the bench's mask


def calibrate_bench(
    reference: Path, *, dark: Path | None, bench: Bench, progress: Progress = lambda *_: None
) -> CalibratedBench:
    """Find the lattice in a reference image file; `InputError` if the files are unusable."""
    import numpy as np

    from app.images import read_image
    from app.measurement.mask_scale import mask_scale
    from app.measurement.offline_reconstructor import full_scale_of
    from reconstruction.errors import ReconstructionError
    from reconstruction.lattice.search import survey

    image = read_image(reference)
    dark_image = None if dark is None else read_image(dark)
    try:
        most = full_scale_of(image, bench.camera_model.bits)
        found = survey(image, bench.sensor, dark=dark_image, full_scale=most, progress=progress)
        calibrated = dataclasses.replace(bench, sensor=found.sensor, lattice=_rounded(found.lattice))
        light = np.subtract(image, 0 if dark_image is None else dark_image, dtype=np.float32)
        try:
            scale = mask_scale(calibrated, light)
        except ReconstructionError:  # too little light, or none above the dark
            scale = None
        return CalibratedBench(image, bench, calibrated, found, scale)
    except ReconstructionError as error:
        raise InputError(f"{dark if error.image == 'dark' else reference}: {error}") from error
    except ValueError as error:  # a pitch far from the design
        raise InputError(f"{reference}: {error}; check the sensor's lenslet_pitch_m and pixel_pitch_m") from error


def find_linearity(bench: Bench, frames: int | None, progress: Progress) -> MeasuredLinearity:
    """Measure the nonlinearity of a bench's camera with its devices; `RunError` says why it cannot."""
    from app.acquisition.session import LiveBench
    from app.acquisition.start_up import without_sample
    from drivers.interface import DeviceError

    live = LiveBench(bench, average=0, progress=progress)
    try:
        with live:
            if request := without_sample(bench):
                terminal.ask(request)
            return live.measure_linearity(frames or EXPOSURE_FRAMES)
    except DeviceError as error:
        raise RunError(live.failure or str(error)) from error


def linearity_summary(measured: MeasuredLinearity) -> list[str]:
    """Return the nonlinearity as lines of text."""
    found = measured.linearity
    return [
        f"linearity    {found.sentence}, +- {100 * measured.sigma:.3f} %",
        f"quadratic    {found.quadratic:+.5f} +- {found.quadratic_sigma:.5f}",
        f"cubic        {found.cubic:+.5f} +- {found.cubic_sigma:.5f}",
        f"chi-square   {found.chi_square:.2f} of the exposures against the curve, reduced",
        f"exposures    {measured.late_s * 1e3:+.4f} +- {measured.late_sigma_s * 1e3:.4f} ms longer than reported",
        f"light        drifted by {100 * measured.drift:+.2f} %, flickers by {100 * measured.flicker:.3f} %",
    ]


def _rounded(lattice: Lattice) -> Lattice:
    """Drop insignificant digits."""
    numbers = {name: value for name, value in dataclasses.asdict(lattice).items() if isinstance(value, float)}
    rounded: dict[str, Any] = {
        name: round(value, 9 if name.endswith("_rad") else 6) + 0.0 for name, value in numbers.items()
    }
    return dataclasses.replace(lattice, **rounded)


def summary(calibrated: CalibratedBench) -> list[str]:
    """Return the result as lines of text."""
    lattice, seen = calibrated.survey.lattice, calibrated.survey
    rows, columns = seen.illuminated.shape
    size, source = calibrated.mask_scale, calibrated.design.simulation.source
    scale = f"unknown: the reference does not show the mask {source.mask} of [simulation.source]"
    if size is not None:
        scale = f"{size.scale:.5f} +- {size.sigma:.5f} of what the bench's lengths say, by the mask {size.mask}"
    return [
        f"pitch        {lattice.pitch_text(4)}",
        f"rotation     {lattice.rotation_rad * 1e3:+z.3f} mrad ({math.degrees(lattice.rotation_rad):+z.3f} degrees)",
        f"centre       x {lattice.center_x_px:.3f} px, y {lattice.center_y_px:.3f} px",
        f"lenslets     {seen.rows} x {seen.columns} bright on the frame; {rows} x {columns} are used",
        f"illuminated  {seen.illuminated.sum()} of {rows * columns} ({100 * seen.illuminated.mean():.1f} %)",
        f"quality      subimages {seen.residual_px:.3f} px RMS off the lattice, {100 * seen.likeness:.0f} % similar",
        f"scale        {scale}",
    ]


def differences(calibrated: CalibratedBench) -> list[str]:
    """Return the differences to the bench as given, one sentence each."""
    sensor, seen = calibrated.design.sensor, calibrated.survey
    sentences = []
    off = seen.lattice.pitch_px / sensor.lenslet_pitch_px - 1
    if abs(off) > _NOTEWORTHY:
        sentences.append(f"the pitch is {100 * off:+.1f} % off the design, {sensor.lenslet_pitch_px:.4f} px")
    if stretch := seen.lattice.stretch:
        sentences.append(f"the pitch differs by {200 * math.hypot(*stretch):.1f} % with direction, and is used so")
    if sensor.lenslet_rows and sensor.lenslet_columns and (seen.rows, seen.columns) != sensor.lenslets:
        sentences.append(
            f"the frame shows {seen.rows} x {seen.columns} lenslets with light, the bench has"
            f" lenslet_rows = {sensor.lenslet_rows}, lenslet_columns = {sensor.lenslet_columns}"
        )
    return sentences + ([] if calibrated.mask_scale is None else calibrated.mask_scale.faults)


def as_numbers(calibrated: CalibratedBench) -> dict[str, float | int | str | list[str] | None]:
    """Return the result for JSON, with the names of the bench's TOML keys."""
    seen, size = calibrated.survey, calibrated.mask_scale
    return {
        **dataclasses.asdict(seen.lattice),
        "whole_rows": seen.rows,
        "whole_columns": seen.columns,
        "lenslets": int(seen.illuminated.size),
        "illuminated": int(seen.illuminated.sum()),
        "residual_px": seen.residual_px,
        "likeness": seen.likeness,
        "scale": None if size is None else size.scale,
        "scale_sigma": None if size is None else size.sigma,
        "orientation": None if size is None else size.orientation,  # empty as the bench has it
        "differences": differences(calibrated),
    }


def write_found(bench: Bench, name: str, source: str, path: Path) -> None:
    """Write a bench with its section `name`, keeping the comments of `source`, a TOML file or preset."""
    from app.bench.bench_files import bench_file, read_bench_text

    write_whole(path, bench_text(read_bench_text(bench_file(source)), bench, name))


def bench_text(text: str, bench: Bench, name: str = "lattice") -> str:
    """Insert the lattice and omitted counts, or the linearity, of `bench` into its TOML text, keeping the comments.

    If the result would not read back to the same bench, for example after --set, the whole bench is written anew.
    """
    import tomli_w

    from app.bench.config import parse_bench, write_bench

    found = getattr(bench, name)
    values = {} if found is None else {key: each for key, each in dataclasses.asdict(found).items() if each is not None}
    section = f"[{name}] # found by svwfs calibrate\n{tomli_w.dumps(values)}\n"
    before = re.compile(rf"^\[{name}\][^\n]*\n(?:(?!\[)[^\n]*\n)*", re.MULTILINE)
    edited, count = before.subn(lambda _: section, text, count=1)
    if not count:
        edited = f"{text.rstrip()}\n\n{section}"
    rows, columns = bench.sensor.lenslet_rows, bench.sensor.lenslet_columns
    counts = (f"{key} = {count}\n" for key, count in (("lenslet_rows", rows), ("lenslet_columns", columns)) if count)
    missing = "".join(each for each in counts if not re.search(rf"^\s*{each.split()[0]}\b", text, re.MULTILINE))
    edited = re.sub(r"^\[sensor\][^\n]*\n", lambda header: header[0] + missing, edited, count=1, flags=re.MULTILINE)
    try:
        is_same = parse_bench(edited, "the calibrated bench") == bench
    except InputError:
        is_same = False
    return edited if is_same else write_bench(bench)

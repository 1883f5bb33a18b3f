"""`svwfs deconvolve`: an image of the sample without the aberration that was measured through it."""

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from app.bench.bench_files import read_bench_text
from app.bench.config import Bench
from app.errors import InputError, Interrupted
from app.files import atomic_write, check_outputs, check_readable, check_suffix, in_words
from app.images import read_image
from app.progress import Progress, between
from app.recording.folder import parts_of
from app.results.sources import mean_wavefront, read_bench_of
from reconstruction.arrays import Counts
from reconstruction.deconvolution.corrected_image import CorrectedImage, PhaseAt, RestorationMethod, corrected_image

_READING = 0.1  # share of the work


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Image, wavefronts, output and settings of a deconvolution."""

    image: Path
    source: Path  # file of results, or folder of a recording
    out: Path
    imaging: Path | None = None  # TOML file with a section [imaging]
    settings: tuple[str, ...] = ()  # "section.key=value"
    frames: str | None = None  # FIRST:END
    method: RestorationMethod = "richardson-lucy"
    iterations: int
    overwrite: bool = False


def deconvolve(plan: Plan, progress: Progress) -> CorrectedImage:
    """Correct an image and write it as TIFF: the image, and on a second page 255 where it is corrected, else 0.

    Raises
    ------
    InputError
        If image, geometry and wavefront do not go together.
    Interrupted
        On Ctrl-C; nothing is written.
    """
    bench = read_bench_of(plan.source, (*_section(plan.imaging), *plan.settings))
    source = parts_of(plan.source) if plan.source.is_dir() else [plan.source]
    check_readable(plan.image)
    check_outputs([plan.out], inputs=[plan.image, plan.imaging, *source, *bench.files], overwrite=plan.overwrite)
    check_suffix(plan.out, ".tif", ".tiff")
    image = read_image(plan.image)
    try:
        phase_at = mean_wavefront(plan.source, bench, plan.frames, between(progress, 0, _READING))
        corrected = correct(
            image, phase_at, bench, plan.method, plan.iterations, between(progress, _READING, 1), name=str(plan.image)
        )
        _write(plan, corrected)
    except Interrupted:
        raise Interrupted(f"interrupted: {plan.out} is not written") from None
    return corrected


def correct(
    image: Counts,
    phase_at: PhaseAt,
    bench: Bench,
    method: RestorationMethod,
    iterations: int,
    progress: Progress,
    *,
    name: str,
) -> CorrectedImage:
    """Correct an image with the geometry of a bench; `name` stands for the image in errors."""
    if bench.imaging is None:
        raise InputError(
            f"{name}: its scale is unknown: give --scale, the size of a pixel in the field in m, or [imaging] pixel_m"
        )
    try:
        return corrected_image(
            image,
            phase_at,
            bench.imaging,
            sensor=bench.sensor,
            field=bench.field,
            method=method,
            iterations=iterations,
            progress=progress,
        )
    except ValueError as error:
        raise InputError(f"{name}: {error}") from error


def _section(path: Path | None) -> list[str]:
    """Read the section [imaging] of a TOML file as settings."""
    if path is None:
        return []
    try:
        section = tomllib.loads(read_bench_text(path)).get("imaging")
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {in_words(error)}") from error
    if not isinstance(section, dict) or not section:
        raise InputError(f"{path}: has no section [imaging]")
    return [f"imaging.{key}={json.dumps(value, default=str)}" for key, value in section.items()]


def _write(plan: Plan, corrected: CorrectedImage) -> None:
    about = {
        "image": plan.image.name,
        "with": plan.source.name,
        "method": plan.method,
        "iterations": corrected.iterations,
        "chi_square": corrected.chi_square if np.isfinite(corrected.chi_square) else None,
    }
    with atomic_write(plan.out) as temporary, tifffile.TiffWriter(temporary) as writer:
        writer.write(corrected.image, description=json.dumps(about), metadata=None)
        marked = np.where(corrected.inside, 255, 0).astype(np.uint8)
        writer.write(marked, description="255 where the image is corrected", metadata=None)

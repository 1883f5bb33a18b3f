"""The work of `svwfs corrector`."""

from dataclasses import dataclass
from pathlib import Path

import xarray as xr

from app.errors import InputError
from app.files import atomic_write, check_outputs, check_suffix
from app.progress import Progress, between
from app.recording.folder import parts_of
from app.results.corrector import (
    check_phase_path,
    compare_correctors,
    correction_dataset,
    correction_figure,
    write_phase,
)
from app.results.figures import check_plot_path
from app.results.layers import Origin, ratio_at
from app.results.result_file import write_results
from app.results.sources import mean_wavefront, read_bench_of
from reconstruction.layers.corrector import Corrector


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Source, corrector and outputs of a comparison over the distance."""

    source: Path  # file of results, or folder of a recording
    frames: str | None  # FIRST:END; all if None
    corrector: Corrector
    distance_m: float | None  # of the corrector; None: the best one
    origin: Origin  # of distances
    out: Path
    plot: Path | None
    command: Path | None  # phase map of the best command
    pixels: int  # of its longer side
    overwrite: bool


def correct(plan: Plan, progress: Progress) -> xr.Dataset:
    """Compare correctors at every distance, and write the best command of one of them."""
    source = plan.source
    check_suffix(plan.out, ".nc")
    inputs = parts_of(source) if source.is_dir() else [source]
    check_outputs([plan.out, plan.plot, plan.command], inputs=inputs, overwrite=plan.overwrite)
    if plan.plot is not None:
        check_plot_path(plan.plot)
    if plan.command is not None:
        check_phase_path(plan.command)
    bench = read_bench_of(source)
    ratio = None if plan.distance_m is None else ratio_at(plan.distance_m, plan.origin, bench)
    phase_at = mean_wavefront(source, bench, plan.frames, between(progress, 0, 0.7))
    try:
        made = compare_correctors(phase_at, bench.sensor, bench.field, plan.corrector, ratio)
    except ValueError as error:
        raise InputError(f"{source}: {error}") from error
    progress("writing", 0.9)
    found = correction_dataset(made, bench, plan.origin)
    write_results(plan.out, found, bench=bench, inputs={"source": source.name})
    if plan.command is not None:
        write_phase(plan.command, made.chosen.phase_map(plan.pixels)[2])
    if plan.plot is not None:
        with atomic_write(plan.plot) as temporary:
            correction_figure(found).savefig(temporary, dpi=150)
    progress("writing", 1.0)
    return found

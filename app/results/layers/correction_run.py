"""`svwfs corrector`: what one corrector could do, over its distance, and its best command."""

from pathlib import Path

import xarray as xr

from app.errors import InputError
from app.files import atomic_write, check_outputs, check_suffix
from app.progress import Progress, between
from app.recording.folder import parts_of
from app.results.dataset import write_results
from app.results.field_wavefront import mean_wavefront, read_bench_of
from app.results.layers.correction import compare_correctors, correction_dataset
from app.results.layers.correction_figure import correction_figure
from app.results.layers.dataset import Origin, ratio_at
from app.results.layers.phase_files import check_phase_path, write_phase
from app.results.plot import check_plot_path
from reconstruction.layers.corrector import Corrector


def correct(  # noqa: PLR0913 - the options of the command
    source: Path,
    *,
    corrector: Corrector,
    at_m: float | None,
    origin: Origin,
    frames: str | None,
    out: Path,
    plot: Path | None,
    command: Path | None,
    pixels: int,
    overwrite: bool,
    progress: Progress,
) -> xr.Dataset:
    """Compare correctors at every distance, and write the best one's command, or that of the one at `at_m`."""
    check_suffix(out, ".nc")
    check_outputs([out, plot, command], inputs=parts_of(source) if source.is_dir() else [source], overwrite=overwrite)
    if plot is not None:
        check_plot_path(plot)
    if command is not None:
        check_phase_path(command)
    bench = read_bench_of(source)
    chosen = None if at_m is None else ratio_at(at_m, origin, bench)
    phase_at = mean_wavefront(source, bench, frames, between(progress, 0, 0.7))
    try:
        made = compare_correctors(phase_at, bench.sensor, bench.field, corrector, chosen)
    except ValueError as error:
        raise InputError(f"{source}: {error}") from error
    progress("writing", 0.9)
    found = correction_dataset(made, bench, origin)
    write_results(out, found, bench=bench, inputs={"source": source.name})
    if command is not None:
        write_phase(command, made.chosen.phase_map(pixels)[2])
    if plot is not None:
        with atomic_write(plot) as temporary:
            correction_figure(found).savefig(temporary, dpi=150)
    progress("writing", 1.0)
    return found

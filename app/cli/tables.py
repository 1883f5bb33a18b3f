"""Result tables and progress bar on the terminal."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from app.batch.run import Batch
from app.cli import printable
from app.errors import InputError
from app.evaluation.selftest import Check
from app.measurement.assumptions import sample_sentence
from app.progress import LINE_START, LINES, counted
from app.recording.recover import Recovered
from app.results.dataset import rotation_of
from app.results.frame_tallies import ROTATES, Measured, QualityTally, rms_noise, rms_text, rotation_sentence
from app.results.replay import Replay
from app.results.report.summary import Residual
from app.results.sources import version_notice
from reconstruction.arrays import Floats
from reconstruction.displacement import Outcome
from reconstruction.geometry import Field
from reconstruction.registration.circulation import Circulation
from reconstruction.wavefront import Wavefront, peak_to_valley, rms


def print_views(wavefront: Wavefront) -> None:
    """Print RMS with error bar and PV of every view, arranged as in the field, what was assumed, and the lenslets."""
    noise_rad = rms_noise(wavefront)
    cells = ((_cell(*each) for each in zip(*row, strict=True)) for row in zip(wavefront.views, noise_rad, strict=True))
    _print_by_view(wavefront.field, "RMS +- error bar and PV (rad) of the wavefront at each field position", cells)
    Console().print(lenslet_summary(wavefront))
    _print_sentence(f"assumed: {sample_sentence(wavefront.sample, wavefront.field)}")
    rotation = rotation_of(wavefront)
    if rotation is not None:
        _print_rotation(rotation, rotates=rotation.contradicts_layers)


def _cell(view: Floats, noise_rad: float) -> str:
    """RMS and PV of a view, rad; no PV if the wavefront is below the noise."""
    rms_rad = float(rms(view))
    text = rms_text(rms_rad, noise_rad)
    return text if rms_rad < noise_rad else f"{text}\nPV {peak_to_valley(view):.2f}"


def print_refinement(changes_rad: Sequence[float]) -> None:
    """Print how much each round of refinement changed the wavefront."""
    changes = ", ".join(f"{change_rad:.4f}" for change_rad in changes_rad)
    Console().print(
        f"refined in {counted(len(changes_rad), 'round')}, changing the wavefront by {changes} rad RMS"
        if changes
        else "not refined: it would not improve"
    )


def print_measurement(measured: Measured, out: Path) -> None:
    """Print mean and scatter of every view's RMS over the frames, its error bar, and the folder of the results."""
    has_scatter = measured.reconstructed > 1
    of = f", mean +- scatter of {measured.reconstructed} frames" if has_scatter else " +- error bar"
    errors_rad = measured.scatter_rms_rad if has_scatter else measured.noise_rad
    rows = zip(measured.mean_rms_rad, errors_rad, measured.noise_rad, strict=True)
    cells = (
        (
            rms_text(mean, noise) if mean < noise else f"{mean:.3f} +- {error:.3f}"
            for mean, error, noise in zip(*row, strict=True)
        )
        for row in rows
    )
    _print_by_view(measured.bench.field, f"RMS (rad) of the wavefront{of}", cells)
    _print_sentence(f"error bar of one frame: {np.nanmean(measured.noise_rad):.3f} rad; assumed: {measured.assumed}")
    light = "" if measured.light_current_a is None else f", light current {measured.light_current_a:.4g} A"
    _print_sentence(f"exposure {measured.exposure_s * 1e3:.4g} ms{light}")
    if measured.mask_note:
        _print_sentence(measured.mask_note)
    failed = measured.recorded - measured.reconstructed
    why = f", {failed} not reconstructed ({measured.problem})" if failed else ""
    if measured.rotation is not None:
        _print_rotation(measured.rotation, rotates=2 * measured.rotating > measured.reconstructed)
    print_quality(measured.quality)
    counts = f"{counted(measured.recorded)}{why}, {measured.lost} lost by the camera; all is in {out}"
    _print_sentence(counts)


def print_recovered(recovered: Recovered, folder: Path) -> None:
    """Print the state of a recording, what was repaired, and its damage."""
    state = "was complete" if recovered.was_complete else "is complete now"
    damaged = ", but damaged" if recovered.damage else ""
    typer.echo(printable(f"{folder}: {state}{damaged}: {recovered.summary}"))
    for sentence in (*recovered.rebuilt, *recovered.damage, recovered.readable, recovered.put_aside):
        if sentence:
            typer.echo(printable(f"{folder}: {sentence}"))


def print_replay(made: Replay) -> None:
    """Print whether the frames were reproduced, or how much another bench's wavefronts differ."""
    console, compared = Console(), made.comparison
    if compared is not None and compared.field is not None:
        rows = zip(compared.recorded_rms_rad, compared.rms_rad, compared.difference_rms_rad, strict=True)
        cells = (
            (f"{then:.3f} > {now:.3f}\n{apart:.3f} apart" for then, now, apart in zip(*row, strict=True))
            for row in rows
        )
        title = f"RMS (rad) as recorded > with this bench, mean of {counted(compared.frames)}"
        _print_by_view(compared.field, title, cells)
    elif compared is not None and made.reconstructed:
        console.print(
            "this bench has other views or lenslets than the recorded one: nothing to compare", soft_wrap=True
        )
    if made.unrefined:
        console.print(f"{counted(made.unrefined)} refined when recorded, but not with this bench")
    if made.verification is not None:
        (print_warning if made.verification.different else _print_sentence)(made.verification.sentence)
    print_quality(made.quality)
    if made.assumed:
        _print_sentence(f"assumed: {made.assumed}")
    failed = made.frames - made.reconstructed
    if failed or made.verification is None:  # else the verification has counted them
        why = f"; {failed} could not be reconstructed ({made.problem})" if failed else ""
        _print_sentence(f"{counted(made.frames)}{why}")


def print_version_notice(*sources: Path, settings: tuple[str, ...] = ()) -> None:
    """Print of recordings or results whose version neglected the propagation of light that this is done again."""
    for source in sources:
        with suppress(InputError):  # of a source that the command has refused
            if notice := version_notice(source, settings):
                _print_sentence(f"{source}: {notice}")


def print_batch(batch: Batch, out: Path) -> None:
    """Print why recordings and frames failed, and the number of frames in the store."""
    for reason in batch.failed.values():
        print_warning(reason)
    for copy, original in batch.copies.items():
        print_warning(f"{copy}: is a copy of {original}, whose results are in the store under one name")
    for folder, reasons in batch.damaged.items():
        print_warning(f"{folder}: {counted(len(reasons))} damaged and left out: {reasons[0]}")
    without = batch.frames - batch.wavefronts
    why = f" ({batch.problem})" if batch.problem else ""
    missing = f"; {without} have no wavefront{why}" if without else ""
    done = batch.recordings - len(batch.failed)
    before = f", {batch.frames - batch.computed} of them from before" if batch.frames > batch.computed else ""
    _print_sentence(f"{counted(done, 'recording')} with {counted(batch.frames)}{before} are in {out}{missing}")


def print_quality(quality: QualityTally) -> None:
    """Print a warning for each fault of the frames, and a note of what could not be judged."""
    for sentence in quality.sentences:
        print_warning(f"doubtful: {sentence}")
    if quality.unjudged:
        _print_sentence(f"note: {quality.unjudged}")


def print_residual(residual: Residual) -> None:
    """Print the RMS difference of two recordings' mean wavefronts at every view, and the paper's three numbers."""
    title = f"RMS (rad) of {residual.name} minus {residual.other_name}, means of their frames"
    _print_by_view(residual.field, title, ((f"{value:.3f}" for value in row) for row in residual.rms_rad))
    _print_sentence(residual.sentence)


def print_checks(checks: Iterable[Check]) -> bool:
    """Print each check of the selftest as it finishes; return whether all passed."""
    console = Console()
    console.print("what was put in                       RMS (rad)   scale   residual (rad)")
    passed = []
    for check in checks:
        passed.append(check.passes)
        verdict = "[green]ok[/]" if check.passes else "[red]WRONG[/]"
        numbers = f"{check.rms_rad:9.3f}  {check.scale:6.3f}  {check.residual_rad:15.4f}"
        console.print(f"{check.name:36s}  {numbers}   {verdict}", highlight=False)
    return all(passed)


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Progress bar on standard error, or lines for the program that asked for them; yields its callback."""
    if os.environ.get(LINES):
        yield lambda _, fraction: typer.echo(f"{LINE_START}{fraction:.3f}", err=True)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("starting", total=1.0)
        yield lambda text, fraction: progress.update(task, description=text or "waiting", completed=fraction)


def _print_sentence(text: str) -> None:
    """Print text that may come from a file; without control codes, which could change the terminal."""
    Console().print(printable(text), markup=False, highlight=False, soft_wrap=True)


def _print_by_view(field: Field, title: str, cells: Iterable[Iterable[str]]) -> None:
    """Print a table with a cell (view_row, view_column) for each view; where it is too wide, break before brackets."""
    texts, table, console = [list(row) for row in cells], Table(title=title), Console()
    widest = max(len(line) for row in texts for cell in row for line in cell.splitlines())
    if 14 + (3 + widest) * field.view_columns > console.width:  # with lines and margins
        texts = [[cell.replace(" (", "\n(") for cell in row] for row in texts]
    table.add_column("y \\ x (mm)", justify="right")
    for x_m in field.view_x_m:
        table.add_column(f"{x_m * 1e3:+.2f}", justify="right")
    inside = field.contains(field.view_x_m / field.half_width_m, field.view_y_m[:, None] / field.half_width_m)
    for y_m, row, is_inside in zip(field.view_y_m, texts, inside, strict=True):
        shown = (cell if lies else "outside" for cell, lies in zip(row, is_inside, strict=True))
        table.add_row(f"{y_m * 1e3:+.2f}", *shown)
    console.print(table)
    if not inside.all():
        console.print("outside: these views lie outside the circular field")


def _print_rotation(rotation: Circulation, *, rotates: bool) -> None:
    """Print the rotation of the subimages, and a warning if it contradicts layers."""
    Console().print(rotation_sentence(rotation), highlight=False, soft_wrap=True)
    if rotates:
        print_warning(ROTATES)


def print_warning(sentence: str) -> None:
    """Print a warning."""
    Console().print(f"[yellow]warning:[/] {escape(printable(sentence))}", highlight=False, soft_wrap=True)


def lenslet_summary(wavefront: Wavefront) -> str:
    """Summarise the lenslets, as "223 of 225 lenslets valid; 2 dark; 40 % of the dynamic range used"."""
    outcome = wavefront.displacement.outcome
    lost = (
        f"{count} {Outcome(code).name.lower().replace('_', ' ')}"
        for code, count in zip(*np.unique(outcome, return_counts=True), strict=True)
        if code != Outcome.CONVERGED
    )
    valid = f"{np.count_nonzero(wavefront.displacement.valid)} of {outcome.size} lenslets valid"
    used = np.nanmax(wavefront.displacement.range_used, initial=0.0)
    return "; ".join([valid, *lost, f"{100 * used:.0f} % of the dynamic range used"])

"""`svwfs replay`: reconstruct a recording again, to verify it or to compare another bench."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.commands import options, terminal
from app.progress import counted

if TYPE_CHECKING:
    from app.results.replay import Replay


def replay(
    recording: options.RecordingFolder,
    *,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Fail if a frame differs from what was recorded by over a thousandth of sigma."),
    ] = False,
    bench: Annotated[str | None, options.bench_option("Another bench to compare with the recorded one.")] = None,
    setting: options.Set = None,
    frames: options.Frames = None,
    out: Annotated[Path | None, typer.Option(help="NetCDF file for the results.")] = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Reconstruct the frames of a recording again.

    Dark, reference, lattice and refinement are the recorded ones, and results are compared with the recorded results: a
    difference beyond a thousandth of the standard deviation is reported (`svwfs docs recording`). With another --bench,
    or the recorded one changed by --set, the wavefronts are compared with the recorded ones view by view.

    Example: svwfs replay run1 --verify

    Example: svwfs replay run1 --set reconstruction.method=zonal
    """
    options.check_recordings(recording)
    from app.recording.reader import Recording
    from app.results.replay import change_of, changed_bench
    from app.results.replay import replay as run

    settings, other = tuple(setting or ()), None if bench is None else options.load(bench, setting)
    reads: tuple[Path, ...] = ()
    if bench is not None and other is not None:
        reads = options.files_of_bench(bench, other)
    elif settings:
        reads = changed_bench(Recording(recording).bench, settings).files
    options.check_files(out, reads=reads, sources=[recording], suffixes=(".nc",), overwrite=overwrite)
    with terminal.progress_bar() as progress:
        change = change_of(other, settings)
        made = run(recording, change, frames=frames, out=out, must_match=verify, progress=progress)
    print_replay(made)
    terminal.print_missing_lines(recording)


def print_replay(made: Replay) -> None:
    """Print whether the frames were reproduced, or how much another bench's wavefronts differ."""
    compared = made.comparison
    if compared is not None and compared.field is not None:
        rows = zip(*compared.means_rad, strict=True)
        cells = (("{:.3f} > {:.3f}\n{:.3f} apart".format(*each) for each in zip(*row, strict=True)) for row in rows)
        title = f"RMS (rad) as recorded > with this bench, mean of {counted(compared.frames)}"
        terminal.print_by_view(compared.field, title, cells)
    elif compared is not None and made.reconstructed:
        terminal.print_sentence("this bench has other views or lenslets than the recorded one: nothing to compare")
    if made.unrefined:
        terminal.print_sentence(f"{counted(made.unrefined)} refined when recorded, but not with this bench")
    if made.verification is not None:
        (terminal.print_warning if made.verification.different else terminal.print_sentence)(made.verification.sentence)
    terminal.print_quality(made.quality)
    if made.assumed:
        terminal.print_sentence(f"assumed: {made.assumed}")
    failed = made.frames - made.reconstructed
    if failed or made.verification is None:  # else the verification has counted them
        why = f"; {failed} could not be reconstructed ({made.problem})" if failed else ""
        terminal.print_sentence(f"{counted(made.frames)}{why}")

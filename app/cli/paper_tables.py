"""The paper's tables: `svwfs paper table1`, `table2` and `sources`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.options import BenchOption, SeedsOption, SetOption, load

if TYPE_CHECKING:
    from app.evaluation.paper.tables import Table

paper = typer.Typer(help="The paper's tables, theirs and ours side by side.", no_args_is_help=True)
OutOption = Annotated[Path, typer.Option(help="Folder for the table as JSON and CSV, and its figure.")]
PeersOption = Annotated[bool, typer.Option(help="Also the slow methods of SimpleITK (svwfs[peers]).")]


@paper.command()
def table1(
    *,
    out: OutOption,
    seeds: SeedsOption = 1,
    peers: PeersOption = False,
    bench: BenchOption = "paper_simulation",
    setting: SetOption = None,
) -> None:
    """Table 1: every method on the simulated bench, against the truth."""
    from app.evaluation.paper.tables import table1 as run

    _paper_table(lambda progress: run(load(bench, setting), seeds, peers=peers, progress=progress), out)


@paper.command()
def table2(
    *,
    out: OutOption,
    seeds: SeedsOption = 1,
    peers: PeersOption = False,
    bench: BenchOption = "paper_experiment",
    setting: SetOption = None,
) -> None:
    """Table 2: every method on noisy frames of the experiment, against the stars."""
    from app.evaluation.paper.tables import table2 as run

    _paper_table(lambda progress: run(load(bench, setting), seeds, peers=peers, progress=progress), out)


@paper.command()
def sources(
    *, out: OutOption, seeds: SeedsOption = 1, bench: BenchOption = "paper_simulation", setting: SetOption = None
) -> None:
    """The supplement's study: sources of other shapes."""
    from app.evaluation.paper.tables import sources as run

    _paper_table(lambda progress: run(load(bench, setting), seeds, progress=progress), out)


def _paper_table(run: Callable[[Callable[[str, float], None]], Table], out: Path) -> None:
    """Make a table under a progress bar, write it and print it."""
    from app.cli.tables import progress_bar
    from app.evaluation.paper.output import print_table, write_table
    from app.files import make_folder

    make_folder(out)
    with progress_bar() as progress:
        table = run(progress)
    write_table(table, out)
    print_table(table)

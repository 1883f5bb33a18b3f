"""`svwfs paper`: the tables of the paper beside its own numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from app.commands import options
from app.commands.study import run_and_print

paper = typer.Typer(
    help="Reproduce the paper's tables beside its own numbers.", no_args_is_help=True, rich_markup_mode=None
)
OutOption = Annotated[Path, options.folder_option("Folder for the table (JSON, CSV) and its figure.")]
PeersOption = Annotated[bool, typer.Option(help="Include the slow methods of SimpleITK (extra: peers).")]


def _reproduce(
    name: str, bench: str, setting: list[str] | None, seeds: int, out: Path, *, overwrite: bool, **peers: bool
) -> None:
    from app.evaluation import paper as tables
    from app.evaluation.studies import files_of

    loaded, table = options.load(bench, setting), getattr(tables, name)(**peers)
    job = options.Job(*files_of([table], out), reads=loaded.files, overwrite=overwrite)
    run_and_print(job, [table], loaded, seeds, out)


@paper.command(cls=options.OnceCommand)
def table1(
    *,
    out: OutOption,
    seeds: options.Seeds = 1,
    peers: PeersOption = False,
    overwrite: options.Overwrite = False,
    bench: options.Bench = "paper_simulation",
    setting: options.Set = None,
) -> None:
    """Table 1: every method on the simulated bench, against the truth.

    Example: svwfs paper table1 --out paper
    """
    _reproduce("table1", bench, setting, seeds, out, overwrite=overwrite, peers=peers)


@paper.command(cls=options.OnceCommand)
def table2(
    *,
    out: OutOption,
    seeds: options.Seeds = 1,
    peers: PeersOption = False,
    overwrite: options.Overwrite = False,
    bench: options.Bench = "paper_experiment",
    setting: options.Set = None,
) -> None:
    """Table 2: every method on noisy frames of the experiment, against the stars.

    Example: svwfs paper table2 --seeds 3 --out paper
    """
    _reproduce("table2", bench, setting, seeds, out, overwrite=overwrite, peers=peers)


@paper.command(cls=options.OnceCommand)
def sources(
    *,
    out: OutOption,
    seeds: options.Seeds = 1,
    overwrite: options.Overwrite = False,
    bench: options.Bench = "paper_simulation",
    setting: options.Set = None,
) -> None:
    """The supplement's study of other source shapes.

    Example: svwfs paper sources --out paper
    """
    _reproduce("sources", bench, setting, seeds, out, overwrite=overwrite)

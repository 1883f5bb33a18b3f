"""`svwfs paper`: the tables of the paper beside its own numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from app.bench.presets import PAPER
from app.commands import options
from app.commands.study import run_and_print
from app.errors import InputError

_EXPERIMENT = "paper_experiment"  # the bench of table 2


def paper(
    table: Annotated[
        Literal["table1", "table2", "sources"],
        typer.Argument(
            help="table1: every method on the simulated bench, against the truth; table2: every method on noisy frames "
            "of the experiment, against the stars; sources: the supplement's study of other source shapes."
        ),
    ],
    *,
    out: Annotated[Path, options.folder_option("Folder for the table (JSON, CSV) and its figure.")],
    seeds: options.Seeds = 1,
    peers: Annotated[bool, typer.Option(help="Include the slow methods of SimpleITK (extra: peers).")] = False,
    overwrite: options.Overwrite = False,
    bench: Annotated[
        str | None, options.bench_option(f"Bench TOML file, or a preset [default: {PAPER}; of table2 {_EXPERIMENT}].")
    ] = None,
    setting: options.Set = None,
) -> None:
    """Reproduce the paper's tables beside its own numbers.

    Example: svwfs paper table1 --out paper

    Example: svwfs paper table2 --seeds 3 --out paper
    """
    from app.evaluation.paper import comparison
    from app.evaluation.studies import files_of

    if table == "sources" and peers:
        raise InputError("--peers: the study of source shapes has no methods of SimpleITK")
    bench = bench or (_EXPERIMENT if table == "table2" else PAPER)
    loaded = options.load(bench, setting)
    study = comparison(table, with_peers=peers)
    options.check_files(*files_of([study], out), reads=options.files_of_bench(bench, loaded), overwrite=overwrite)
    run_and_print([study], loaded, seeds=seeds, out=out)

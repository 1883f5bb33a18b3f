"""`svwfs paper`: the tables of the paper next to its own numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from app.bench.presets import PAPER
from app.commands import options, terminal
from app.errors import InputError

_EXPERIMENT = "paper_experiment"  # the bench of table 2


def paper(
    table: Annotated[
        Literal["table1", "table2", "sources"],
        typer.Argument(
            help="Table1: every method on simulated frames, against the truth; table2: every method on noisy frames "
            "of the experiment, against the stars; sources: the supplement's study of other source shapes."
        ),
    ],
    *,
    out: Annotated[Path, options.folder_option("Folder for the table (JSON) and its figure.")],
    seeds: options.Seeds = 1,
    peers: Annotated[bool, typer.Option(help="Include the slow methods of SimpleITK (extra: peers).")] = False,
    overwrite: options.Overwrite = False,
    bench: Annotated[
        str | None, options.bench_option(f"Bench TOML file, or a preset [default: {PAPER}; of table2 {_EXPERIMENT}].")
    ] = None,
    setting: options.Set = None,
) -> None:
    """Reproduce the paper's tables next to the paper's numbers.

    Example: svwfs paper table1 --out paper

    Example: svwfs paper table2 --seeds 3 --out paper
    """
    from app.evaluation.paper import compare, printed, write_table

    if table == "sources" and peers:
        raise InputError("--peers: the study of source shapes has no methods of SimpleITK")
    bench = bench or (_EXPERIMENT if table == "table2" else PAPER)
    loaded = options.load(bench, setting)
    outputs = [out / f"{table}.{suffix}" for suffix in ("json", "png")]
    options.check_files(*outputs, reads=options.files_of_bench(bench, loaded), overwrite=overwrite)
    with terminal.progress_bar() as progress:
        data = compare(table, loaded, seeds=seeds, with_peers=peers, progress=progress)
        write_table(table, data, out)
    terminal.print_table(*printed(table, data))

"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.bench.presets import PRESETS

if TYPE_CHECKING:
    from app.bench.config import Bench

BenchOption = Annotated[
    str, typer.Option("--bench", "-b", metavar="TOML", help=f"Bench TOML file, or a preset: {', '.join(PRESETS)}.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting of the bench, as registration.warp=affine."),
]
FramesOption = Annotated[
    str | None, typer.Option(metavar="FIRST:END", help="Only these frames, counted from 0; END is excluded.")
]
SeedsOption = Annotated[int, typer.Option(min=1, max=1000, help="Number of screens, starting at the bench's seed.")]

WorkersOption = Annotated[
    int | None, typer.Option(min=1, max=1024, help="Number of worker processes on this computer (extra: batch).")
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Use the workers of a running Dask scheduler, as tcp://node1:8786."),
]
DashboardOption = Annotated[
    bool, typer.Option("--dashboard", help="Serve Dask's dashboard of these workers, readable by all users here.")
]

TrustOption = Annotated[
    bool, typer.Option("--trust-library", help="Load the program library that the bench names, now and later.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace existing files, except inputs.")]


def bench_file(bench: str) -> Path:
    """Return the file of a bench, an input that no output may replace."""
    from app.bench.bench_files import bench_file as find

    return find(bench)


def load(bench: str, setting: list[str] | None) -> Bench:
    """Load a bench with the changes given by --set."""
    from app.bench.config import load_bench

    return load_bench(bench, tuple(setting or ()))

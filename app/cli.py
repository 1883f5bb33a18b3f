"""The command `svwfs`: what can be asked of the instrument from a shell.

Each command loads what it needs when it runs, so that help comes at once. Input that cannot be used ends with status 2,
a failure while running with status 1, Ctrl-C with 130; each with one line on standard error.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from app.errors import InputError, RunError

cli = typer.Typer(
    help="Space-variant Shack-Hartmann wavefront sensing, live: the wavefront at every position of the field.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

BenchOption = Annotated[
    str, typer.Option("--bench", "-b", metavar="TOML", help="A bench TOML file, or a preset's name.", show_default=True)
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting of the bench: registration.warp=affine"),
]


def main() -> None:
    """Run the command line and leave with its exit status."""
    try:
        cli(standalone_mode=True)
    except InputError as error:
        _leave(error, 2)
    except RunError as error:
        _leave(error, 1)


def _leave(error: Exception, status: int) -> None:
    sys.stderr.write(f"svwfs: {error}\n")
    raise SystemExit(status) from error


@cli.callback(invoke_without_command=True)
def _common(
    show_version: Annotated[bool, typer.Option("--version", help="Show the version and leave.")] = False,
) -> None:
    if show_version:
        typer.echo(f"svwfs {version('svwfs')}")
        raise typer.Exit


@cli.command()
def reconstruct(
    frame: Annotated[Path, typer.Argument(help="The frame with the sample in: TIFF or NPY.")],
    *,
    reference: Annotated[Path, typer.Option(help="The frame without the sample.")],
    bench: BenchOption,
    out: Annotated[Path, typer.Option(help="NetCDF file to write.")],
    dark: Annotated[Path | None, typer.Option(help="A frame with the light off.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture of the views to write: PNG, PDF or SVG.")] = None,
    setting: SetOption = None,
) -> None:
    """Reconstruct the wavefronts of one frame from image files."""
    from app.config import load_bench
    from app.from_files import reconstruct_files
    from app.plot import plot_views
    from app.report import print_views
    from app.results import result_dataset, write_results

    loaded = load_bench(bench, tuple(setting or ()))
    wavefront = reconstruct_files(frame, reference=reference, dark=dark, bench=loaded)
    inputs = {"frame": frame.name, "reference": reference.name, "dark": dark.name if dark else ""}
    write_results(out, result_dataset(wavefront, loaded), bench=loaded, inputs=inputs)
    if plot is not None:
        plot_views(wavefront, plot)
    print_views(wavefront)

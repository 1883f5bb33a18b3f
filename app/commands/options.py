"""Options that several commands share, the check of files before the work, and the picture after it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand, TyperOption

from app.bench.presets import PRESETS
from app.errors import InputError
from app.files import atomic_write, check_outputs, check_readable, check_suffix, require_suffix

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from app.bench import config

FOLDER = "FOLDER"  # in the help, of an option that names a folder
PICTURES = (".png", ".pdf", ".svg")  # Matplotlib writes others, some by programs that may be missing


def bench_option(text: str = f"Bench TOML file, or a preset: {', '.join(PRESETS)}.") -> Any:
    """Return the option `--bench` with this help."""
    return typer.Option("--bench", "-b", metavar="TOML", help=text)


def folder_option(text: str) -> Any:
    """Return an option that names a folder, with this help."""
    return typer.Option(metavar=FOLDER, help=text)


def average_option(into: str, default: int, least: int = 1) -> Any:
    """Return the option `--average`: how many frames are averaged into what."""
    from app.measurement.averages import AVERAGED_FRAMES  # NumPy, for few commands

    text = f"Number of frames averaged into {into} [default: {default}]."
    return typer.Option(min=least, max=AVERAGED_FRAMES[-1], help=text)


Bench = Annotated[str, bench_option()]
Attach = Annotated[
    bool, typer.Option("--attach", help="Connect to a running instrument (svwfs serve) instead of opening devices.")
]
Instrument = Annotated[str, typer.Option("--name", metavar="NAME", help="Name of the instrument.")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting of the bench, as registration.warp=affine."),
]
Frame = Annotated[int, typer.Option(min=0, help="Frame of the recording or results, counted from 0.")]
Frames = Annotated[
    str | None,
    typer.Option(metavar="FIRST:END", help="Frames to use, counted from 0; END is excluded; -10: is the last 10."),
]
RecordingFolder = Annotated[Path, typer.Argument(metavar="recording", help="Folder of a recording.")]
RunOrResult = Annotated[Path, typer.Argument(metavar="RUN|RESULT", help="Folder of a recording, or a results file.")]
Plot = Annotated[Path | None, typer.Option(help="Picture of the result: PNG, PDF or SVG.")]
Remove = Annotated[str | None, typer.Option(metavar="MODES", help="Modes removed from wavefronts, as tilt,defocus.")]
Order = Annotated[
    Literal["noll", "osa", "fringe"],  # `ZernikeOrder` would load NumPy
    typer.Option(help="Order of Zernike modes: Noll, OSA/ANSI (unit RMS), or fringe (unit amplitude)."),
]
Seeds = Annotated[int, typer.Option(min=1, max=1000, help="Number of screens, starting at the bench's seed.")]

MOST_ROUNDS = 100  # of refinement

Workers = Annotated[int | None, typer.Option(min=1, max=1024, help="Number of worker processes here (extra: batch).")]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Use the workers of a running Dask scheduler, as tcp://node1:8786."),
]

Trust = Annotated[bool, typer.Option("--trust-library", help="Load the library that the bench names, now and later.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files, except inputs.")]


def load(bench: str, setting: list[str] | None) -> config.Bench:
    """Load a bench with the changes given by --set."""
    from app.bench.config import load_bench

    return load_bench(bench, tuple(setting or ()))


def refuse_with_attach(**given: object) -> None:
    """Refuse options that belong to the start of an instrument, if one of them was given."""
    names = [name for name, value in given.items() if value not in {None, False}]
    if names:
        listed = ", ".join(f"--{name.replace('_', '-')}" for name in names)
        raise InputError(f"{listed} cannot go with --attach: the instrument has its bench already (svwfs serve)")


def files_of_bench(bench: str, loaded: config.Bench) -> tuple[Path, ...]:
    """Return the file of a bench and those that it names: inputs that no output may replace."""
    from app.bench.bench_files import bench_file

    return (bench_file(bench), *loaded.files)


def check_recordings(*folders: Path) -> None:
    """Refuse folders of which none holds a recording, before anything is loaded that takes seconds."""
    from app.recording.folder import read_run

    for folder in folders[1:]:
        with suppress(InputError):
            read_run(folder)
            return
    read_run(folders[0])


def files_of_images(*images: Path | None) -> list[Path]:
    """Return the files of images, which may be parts of them; `InputError` if one cannot be read."""
    from app.images import place_of

    files = [place_of(image).file for image in images if image is not None]
    for file in files:
        check_readable(file)
    return files


def check_files(
    *outputs: Path | None,
    reads: Iterable[Path | None] = (),
    sources: Iterable[Path] = (),
    suffixes: tuple[str, ...] = (),
    plot: Path | None = None,
    overwrite: bool,
) -> None:
    """Check the files that a command will write, before its work; None is an option without a value.

    The first has one of some `suffixes` if there are any, `plot` is a picture. No input is replaced: neither files that
    are read, nor those of `sources`, recordings and results. `InputError` says what is wrong.
    """
    from app.recording.folder import parts_of

    parts = [part for each in sources for part in (parts_of(each) if each.is_dir() else [each])]
    check_outputs([*outputs, plot], inputs=[*reads, *parts], overwrite=overwrite)
    if suffixes:
        check_suffix(outputs[0], *suffixes)
    if plot is not None:
        require_suffix(plot, *PICTURES, kind="picture's name")


def draw(plot: Path | None, figure: Callable[[], Figure], *, dpi: int = 150) -> None:
    """Make a figure of the result and write it, if a picture is wanted."""
    if plot is not None:
        with atomic_write(plot) as temporary:
            figure().savefig(temporary, dpi=dpi)


class OnceCommand(TyperCommand):
    """Command that refuses a repeated option, no number, an empty name, and a folder's name for a file."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; refuse repeated options, empty names, NaN, and folders in place of files."""
        values, _, order = self.make_parser(ctx).parse_args(args=list(args))
        for option, count in Counter(order).items():
            given = values.get(option.name)
            texts, name = given if isinstance(given, list | tuple) else [given], option.opts[0]
            kind = option.type_descriptor.annotation  # type: ignore[attr-defined] # typer's own
            is_file = kind in {Path, list[Path]}
            if is_file and "" in texts:
                ctx.fail(f"{name} is empty: give the name of a file or folder")
            if kind in {float, list[float]} and not all(map(_is_finite, texts)):
                ctx.fail(f"{name}: give a finite number")
            if not isinstance(option, TyperOption) or option.multiple or option.is_flag:
                continue
            if count > 1:
                ctx.fail(f"{name} is given {count} times: give it once")
            value = str(given)
            if is_file and value.endswith("/") and option.metavar != FOLDER and not Path(value).is_dir():
                ctx.fail(f"{name} {value}: no such folder; leave the slash out of a file's name")
        return super().parse_args(ctx, args)


def _is_finite(text: object) -> bool:
    """True unless a text is infinite or NaN; the parser refuses other texts."""
    try:
        return math.isfinite(float(str(text)))
    except ValueError:
        return True

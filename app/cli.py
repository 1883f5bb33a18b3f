"""The command `svwfs`: what can be asked of the instrument from a shell.

Each command loads what it needs when it runs, so that help comes at once. Input that cannot be used ends with status 2,
a failure while running with status 1, Ctrl-C with 130; each with one line on standard error.
"""

from __future__ import annotations

import sys
from contextlib import nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from app.ending import ended_by
from app.errors import InputError, Interrupted, RunError
from app.presets import PRESETS

if TYPE_CHECKING:
    from collections.abc import Callable

    from app.config import Bench
    from app.paper.tables import Table

cli = typer.Typer(
    help="Space-variant Shack-Hartmann wavefront sensing, live: the wavefront at every position of the field.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_LIVE_OUT = Path("svwfs-output")
_LIVE_BENCH = "live_demo"

BenchOption = Annotated[
    str, typer.Option("--bench", "-b", metavar="TOML", help=f"A bench TOML file, or a preset: {', '.join(PRESETS)}.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting of the bench: registration.warp=affine"),
]

FramesOption = Annotated[
    str | None, typer.Option(metavar="FIRST:END", help="Some of the frames, counted from 0, END not among them.")
]


def main() -> None:
    """Run the command line and leave with its exit status."""
    with ended_by(_interrupt):  # no KeyboardInterrupt, which the library below would turn into silence
        try:
            cli(standalone_mode=True)
        except InputError as error:
            _leave(error, 2)
        except RunError as error:
            _leave(error, 1)
        except Interrupted as error:
            _leave(error, 130)
        except OSError as error:  # standard output is full or gone
            _leave(error, 1)


def _interrupt(_number: int, _frame: object) -> None:
    raise Interrupted("interrupted")


def _leave(error: BaseException, status: int) -> None:
    sys.stderr.write(f"svwfs: {error}\n")
    raise SystemExit(status) from error


def load(bench: str, setting: list[str] | None) -> Bench:
    """Load a bench with the changes given by --set."""
    from app.config import load_bench

    return load_bench(bench, tuple(setting or ()))


@cli.callback(invoke_without_command=True)
def _common(
    show_version: Annotated[bool, typer.Option("--version", help="Show the version and leave.")] = False,
) -> None:
    if show_version:
        typer.echo(f"svwfs {version('svwfs')}")
        raise typer.Exit


@cli.command()
def live(
    *,
    bench: Annotated[
        str | None,
        typer.Option("--bench", "-b", metavar="TOML", help=f"A bench TOML file, or a preset; {_LIVE_BENCH}."),
    ] = None,
    setting: SetOption = None,
    replay: Annotated[
        Path | None, typer.Option(metavar="RECORDING", help="Show a recording at its own pace, again and again.")
    ] = None,
    frames: FramesOption = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.1, max=86400, help="Close by itself so long after the first wavefront, leaving a screenshot."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the screenshot and the results of such a run.")] = _LIVE_OUT,
) -> None:
    """Open the window: live wavefronts at every field position. Without a display it runs unseen for a few seconds.

    With --replay it shows a recording, by its own bench unless --bench or --set say otherwise, and --frames some of it.
    """
    from app.live import live_window

    if replay is None:
        if frames is not None:
            raise InputError("--frames says which frames of a recording are meant: give --replay RECORDING")
        raise typer.Exit(live_window(load(bench or _LIVE_BENCH, setting), seconds=seconds, out=out))
    from app.replay.player import Player

    player = Player(replay, bench=bench, settings=tuple(setting or ()), frames=frames)
    raise typer.Exit(live_window(player.bench, seconds=seconds, out=out, player=player))


@cli.command()
def measure(
    *,
    bench: BenchOption,
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="How many frames to measure.")],
    out: Annotated[Path, typer.Option(help="Folder that becomes a recording, with results.nc beside the frames.")],
    mask: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="The mask in the beam, for simulation.source.mask: square, stars, ..."),
    ] = None,
    average: Annotated[
        int | None,
        typer.Option(min=1, max=10_000, help="How many frames make the dark, and the reference; 20 unless said."),
    ] = None,
    auto_expose: Annotated[
        bool, typer.Option("--auto-expose", help="Find the exposure first, without the sample: bright, not saturated.")
    ] = False,
    setting: SetOption = None,
) -> None:
    """Measure without a window: dark, reference, sample in, so many frames recorded, results.

    On a bench without motors you are asked to move the mask and the sample. Long exposures: average fewer frames, but
    at least 4, which tell the camera's noise. Pinholes are compared by their centroids, not by a warp:

    svwfs measure --bench B.toml --mask stars --set registration.method=centroids --set reconstruction.method=zonal
    --set camera.amplifier=normal --set camera.exposure_s=3.8 --average 4 --frames 10 --out stars

    Ctrl-C ends it early and keeps everything; docs/recording.md says what is in the folder, docs/experiment.md leads
    through a whole experiment.
    """
    from app.measure import measure as run
    from app.report import print_measurement, progress_bar
    from app.start_up import FRAMES

    loaded = load(bench, [*(setting or []), *([] if mask is None else [f"simulation.source.mask={mask}"])])
    with progress_bar() as report:
        measured = run(loaded, frames, out, report, average=average or FRAMES, auto_expose=auto_expose)
    print_measurement(measured, out)


@cli.command()
def recover(
    recording: Annotated[Path, typer.Argument(help="The folder of a recording.")],
) -> None:
    """Finish a recording whose program was killed, or whose computer lost its power, before it could.

    Nothing that can be read is changed or lost. A recording that is complete stays as it is.
    """
    from app.recording.recover import recover as run
    from app.report import print_recovered, progress_bar

    with progress_bar() as report:
        found = run(recording, lambda fraction: report("looking at the frames", fraction))
    print_recovered(found, recording)


@cli.command()
def replay(
    recording: Annotated[Path, typer.Argument(help="The folder of a recording.")],
    *,
    verify: Annotated[
        bool, typer.Option("--verify", help="Fail unless every frame is made again to the last bit.")
    ] = False,
    bench: Annotated[
        str | None,
        typer.Option("--bench", "-b", metavar="TOML", help="Another bench, to compare with the recorded one."),
    ] = None,
    setting: SetOption = None,
    frames: FramesOption = None,
    out: Annotated[Path | None, typer.Option(help="NetCDF file to write the results to.")] = None,
) -> None:
    """Reconstruct the frames of a recording once more, by the dark, reference, lattice and refinement that they had.

    The same software makes the same of them, to the last bit, and says so. With --bench, or --set for a change of the
    recorded bench, both are made and compared view by view: svwfs replay RECORDING --set reconstruction.method=zonal
    """
    from app.replay.run import replay as run
    from app.report import print_replay, progress_bar

    with progress_bar() as report:
        made = run(
            recording,
            bench=bench,
            settings=tuple(setting or ()),
            frames=frames,
            out=out,
            verify=verify,
            report=report,
        )
    print_replay(made)


@cli.command()
def export(
    recording: Annotated[Path, typer.Argument(help="The folder of a recording.")],
    *,
    to: Annotated[
        Literal["tiff", "csv", "netcdf", "psf"],
        typer.Option(
            help="tiff: the frames; csv: RMS and coefficients; netcdf: all results; psf: what a point becomes."
        ),
    ],
    out: Annotated[Path, typer.Option(help="The file to write.")],
    frames: FramesOption = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it is there.")] = False,
) -> None:
    """Write a recording as other programs read it; docs/export.md says what is in the files.

    tiff is one BigTIFF for ImageJ, with times and settings; csv one row a frame, for pandas or a spreadsheet; netcdf
    what svwfs measure writes; psf one point-spread function a view, the mean of the frames, its sum 1, to sharpen with.
    """
    from app.export.run import export as run
    from app.report import progress_bar

    with progress_bar() as report:
        count = run(recording, to, out, frames=frames, overwrite=overwrite, report=report)
    typer.echo(f"{count} frames of {recording} are in {out}")


@cli.command()
def report(
    recording: Annotated[Path, typer.Argument(help="The folder of a recording.")],
    *,
    out: Annotated[Path, typer.Option(help="The file to write: .pdf, pages of A4, or .png, all in one picture.")],
    beside: Annotated[
        Path | None,
        typer.Option(metavar="RECORDING", help="Another recording of the same sample, to subtract its wavefronts."),
    ] = None,
    setting: SetOption = None,
    frames: FramesOption = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it is there.")] = False,
) -> None:
    """Put a recording on two pages: when, with what, which wavefronts, how sure they are, and what was lost.

    Frames are reconstructed again, at most 200, spread evenly. With --beside a third page subtracts the mean wavefronts
    of another recording view by view, and a table says what is left, as the paper compares a square with stars;
    --set tries another method on the first: svwfs report SQUARE --beside STARS --set registration.method=correlation
    """
    from app.pages.run import report_pages
    from app.report import print_residual, progress_bar

    with progress_bar() as progress:
        summary, residual = report_pages(
            recording,
            out,
            beside=beside,
            settings=tuple(setting or ()),
            frames=frames,
            overwrite=overwrite,
            report=progress,
        )
    if residual is not None:
        print_residual(residual)
    typer.echo(f"the report of {summary.frames_looked_at} is in {out}")


@cli.command()
def calibrate(
    reference: Annotated[Path, typer.Argument(help="A frame without the sample: TIFF or NPY.")],
    *,
    bench: BenchOption,
    out: Annotated[Path | None, typer.Option(help="Bench TOML to write, with the lattice in it.")] = None,
    dark: Annotated[Path | None, typer.Option(help="A frame with the light off.")] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of the frame with its lenslets to write: PNG, PDF or SVG.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file of --out.")] = False,
    setting: SetOption = None,
) -> None:
    """Find the lattice of lenslets in a reference: pitch, rotation, centre, what is lit. Without --out it only tells.

    Look at the picture of --plot before you trust it: every lit image should lie in the middle of its cell.
    """
    import json

    from app.calibrate import as_numbers, check_out, differences, findings, write_calibrated
    from app.calibrate import calibrate as run

    if out is not None:
        check_out(out, overwrite=overwrite)
    if plot is not None:
        from app.plot import check_plot_path

        check_plot_path(plot)
    loaded = load(bench, setting)
    found = run(reference, dark=dark, bench=loaded)
    if plot is not None:
        from app.lattice_plot import plot_lattice

        plot_lattice(found.reference, found.survey, plot)
    if out is not None:
        write_calibrated(found, bench, out)
    if as_json:
        typer.echo(json.dumps(as_numbers(found)))
        return
    typer.echo("\n".join(findings(found)))
    for said in differences(found):
        typer.echo(f"note: {said}", err=True)


@cli.command()
def simulate(
    *,
    bench: BenchOption,
    out: Annotated[Path, typer.Option(help="Folder for dark.tif, reference.tif, frame.tif and truth.nc.")],
    setting: SetOption = None,
    noise_free: Annotated[
        bool, typer.Option("--noise-free", help="Mean photons instead of the camera's counts.")
    ] = False,
) -> None:
    """Render what the simulated bench casts on its camera, and the true wavefronts."""
    from app.report import progress_bar
    from app.simulate import simulate as run

    loaded = load(bench, setting)
    with progress_bar() as report:
        run(loaded, out, noise_free=noise_free, progress=lambda fraction: report("rendering", fraction))
    typer.echo(f"dark.tif, reference.tif, frame.tif and truth.nc are in {out}")


@cli.command()
def devices(
    *,
    check: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Try everything that a device must be able to do on this one, by its name in the list, and print a"
            " report. A light shines for it, with at most a twentieth of its range.",
        ),
    ] = None,
    bench: Annotated[
        str | None,
        typer.Option(
            "--bench",
            "-b",
            metavar="TOML",
            help="With --check camera or --check light: that of this bench, as it says.",
        ),
    ] = None,
    setting: SetOption = None,
) -> None:
    """Say which cameras and lights are connected, how a bench names them, and what is missing to use them.

    Looking switches nothing on. docs/hardware.md says how to connect each.
    """
    from app.device_report import check_and_print, print_devices

    if check is None and bench is None:
        print_devices()
    elif check is None:
        raise InputError("--bench goes with --check camera or --check light")
    else:
        check_and_print(check, None if bench is None else load(bench, setting))


@cli.command()
def selftest() -> None:
    """Prove signs, axes and units on phases that are known in closed form."""
    from app.report import print_checks
    from app.selftest import run_checks

    if not print_checks(run_checks()):
        raise RunError("the selftest failed: this installation must not be trusted")


paper = typer.Typer(help="The paper's tables, theirs and ours side by side.", no_args_is_help=True)
cli.add_typer(paper, name="paper")
PaperOut = Annotated[Path, typer.Option(help="Folder for the table as JSON and CSV, and its figure.")]
Seeds = Annotated[int, typer.Option(min=1, max=1000, help="How many screens, from the bench's seed on.")]
Peers = Annotated[bool, typer.Option(help="Also the slow methods of SimpleITK (svwfs[peers]).")]


@paper.command()
def table1(
    *,
    out: PaperOut,
    seeds: Seeds = 1,
    peers: Peers = False,
    bench: BenchOption = "paper_simulation",
    setting: SetOption = None,
) -> None:
    """Table 1: every method on the simulated bench, against the truth."""
    from app.paper.tables import table1 as run

    _paper_table(lambda report: run(load(bench, setting), seeds, peers=peers, report=report), out)


@paper.command()
def table2(
    *,
    out: PaperOut,
    seeds: Seeds = 1,
    peers: Peers = False,
    bench: BenchOption = "paper_experiment",
    setting: SetOption = None,
) -> None:
    """Table 2: every method on noisy frames of the experiment, against the stars."""
    from app.paper.tables import table2 as run

    _paper_table(lambda report: run(load(bench, setting), seeds, peers=peers, report=report), out)


@paper.command()
def sources(
    *, out: PaperOut, seeds: Seeds = 1, bench: BenchOption = "paper_simulation", setting: SetOption = None
) -> None:
    """The supplement's study: sources of other shapes."""
    from app.paper.tables import sources as run

    _paper_table(lambda report: run(load(bench, setting), seeds, report=report), out)


def _paper_table(run: Callable[[Callable[[str, float], None]], Table], out: Path) -> None:
    """Make a table under a progress bar, write it and print it."""
    from app.files import make_folder
    from app.paper.output import print_table, write_table
    from app.report import progress_bar

    make_folder(out)
    with progress_bar() as report:
        table = run(report)
    write_table(table, out)
    print_table(table)


@cli.command()
def study(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Sweeps; all without a name.")] = None,
    *,
    out: Annotated[Path, typer.Option(help="Folder for study.json, study.csv and estimator.png.")],
    seeds: Seeds = 3,
    bench: BenchOption = "paper_simulation",
    setting: SetOption = None,
) -> None:
    """What the estimator leaves of the truth, against everything that may be hard for it (docs/estimator.md)."""
    from app.report import progress_bar
    from app.study.output import print_study
    from app.study.sweeps import chosen_sweeps, run_study

    sweeps, loaded = chosen_sweeps(names or []), load(bench, setting)
    with progress_bar() as report:
        outcomes = run_study(loaded, sweeps, seeds, out, report)
    print_study(outcomes)


@cli.command()
def benchmark(
    *,
    json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write all numbers as JSON.")] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Fail if a ratio is 20 % worse than the one committed.")
    ] = False,
) -> None:
    """How fast it is beside SimpleITK, OpenCV, scikit-image, pyrtcao and HCIPy (svwfs[peers]); some minutes."""
    from app.benchmark.baseline import load_baseline, worsened
    from app.benchmark.output import print_benchmark, write_benchmark
    from app.benchmark.run import Plan, run_benchmark
    from app.report import progress_bar

    plan = Plan(bench=load("paper_simulation", ["simulation.screen.correlation_length_m=1.6e-3"]))
    with progress_bar() as report:
        result = run_benchmark(plan, report)
    if json is not None:
        write_benchmark(result, json)
    print_benchmark(result)
    if check and (said := worsened(result["ratios"], load_baseline())):
        raise RunError("slower beside the peers than before: " + "; ".join(said))


@cli.command()
def reconstruct(
    frame: Annotated[Path, typer.Argument(help="The frame with the sample in: TIFF or NPY.")],
    *,
    reference: Annotated[Path, typer.Option(help="The frame without the sample.")],
    bench: BenchOption,
    out: Annotated[Path, typer.Option(help="NetCDF file to write.")],
    dark: Annotated[Path | None, typer.Option(help="A frame with the light off.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture of the views to write: PNG, PDF or SVG.")] = None,
    refine: Annotated[
        int, typer.Option(min=0, max=100, help="Rounds of refinement by the forward model, at most.")
    ] = 0,
    setting: SetOption = None,
) -> None:
    """Reconstruct the wavefronts of one frame from image files."""
    from app.from_files import reconstruct_files
    from app.plot import check_plot_path, plot_views
    from app.report import print_refinement, print_views, progress_bar
    from app.results import result_dataset, write_results

    if plot is not None:
        check_plot_path(plot)
    loaded = load(bench, setting)
    with progress_bar() if refine else nullcontext(lambda *_: None) as report:
        found = reconstruct_files(frame, reference=reference, dark=dark, bench=loaded, refine=refine, report=report)
    inputs = {"frame": frame.name, "reference": reference.name, "dark": dark.name if dark else ""}
    dataset = result_dataset(found.wavefront, loaded, with_psf=True).assign_attrs(
        refinement_rounds=len(found.changes_rad)
    )
    write_results(out, dataset, bench=loaded, inputs=inputs)
    if plot is not None:
        plot_views(found.wavefront, loaded.sensor, plot)
    print_views(found.wavefront)
    if refine:
        print_refinement(found.changes_rad)

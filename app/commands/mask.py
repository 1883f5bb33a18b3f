"""`svwfs mask`: a drawing of a mask from which a lithographer can make it, and its predicted accuracy."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.bench.presets import PAPER
from app.commands import options, terminal
from app.errors import InputError
from app.files import require_suffix

if TYPE_CHECKING:
    from app.bench.config import Bench


def mask(
    name: Annotated[
        str, typer.Argument(metavar="NAME|FILE", help="Mask of the simulator, or black-and-white picture of openings.")
    ],
    *,
    size: Annotated[
        str | None,
        typer.Option(metavar="LENGTH", help="Side of the square around the field, as 1.2mm [default: the bench's]."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Drawing to write: SVG, DXF or GDS (GDSII).")] = None,
    accuracy: Annotated[
        bool, typer.Option("--accuracy", help="Predict errors and noise of this mask on the bench, next to the square.")
    ] = False,
    bench: options.Bench = PAPER,
    setting: options.Set = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Draw a mask for a lithographer, or predict how accurate it will be.

    A drawing has the openings in true size, a scale bar and an orientation mark. Masks have openings only, so grey ones
    are refused. [simulation.source] of the bench has their proportions, such as the cells of the checkerboard, and the
    bench determines what its lenslets resolve. DXF and GDS need the extra mask. --accuracy takes grey pictures, too, in
    the size of the bench's field. See `svwfs docs masks`.

    Example: svwfs mask checkerboard --size 1.2mm --out mask.dxf

    Example: svwfs mask four_holes.png --accuracy

    Example: svwfs mask four_holes.npy --size 1200um --bench bench.toml --out mask.svg
    """
    if out is None and not accuracy:
        raise InputError("nothing to do: give --out FILE for a drawing, or --accuracy")
    if accuracy and size is not None:
        raise InputError("--size is for drawings; with --accuracy set simulation.source.half_width_m")
    loaded = options.load(bench, setting)
    options.check_files(out, reads=[*options.files_of_bench(bench, loaded), Path(name)], overwrite=overwrite)
    if out is not None:
        _draw(name, loaded, bench, size, out)
    if accuracy:
        _predict(name, loaded)


def _draw(name: str, loaded: Bench, bench: str, size: str | None, out: Path) -> None:
    """Write the drawing, and print what a lithographer must know."""
    from app.bench.settings_form import typed_number
    from app.masks.drawing import WRITERS, drawing_of, write_drawing
    from app.masks.openings import openings

    source, sensor, field = loaded.simulation.source, loaded.sensor, loaded.field
    size_m = 2 * source.half_width_m if size is None else typed_number(size, "m", 1.0)
    if size_m is None or (size is not None and not size.rstrip().endswith("m")):  # no metres by mistake
        raise InputError(f"--size {size}: give a length with its unit, as 1.2mm or 1200um")
    require_suffix(out, *WRITERS, kind="drawing's name")
    drawn = openings(name, source, size_m)
    drawing = drawing_of(drawn)
    write_drawing(drawing, out)
    terminal.print_sentence(f"{out}: {drawing.notes[0]}")
    for sentence in drawing.notes[1:5]:
        terminal.print_sentence(sentence)
    resolved_m = sensor.wavelength_m * field.collimator_focal_length_m / sensor.lenslet_pitch_m
    seen_m = sensor.lenslet_pitch_m * field.collimator_focal_length_m / sensor.lenslet_focal_length_m
    terminal.print_sentence(f"the lenslets of {bench} resolve {resolved_m * 1e6:.0f} um")
    for what, length_m in (("feature", drawn.width_m), ("gap", drawn.gap_m)):
        if length_m is not None and length_m < resolved_m:
            terminal.print_warning(
                f"the minimum {what} of {length_m * 1e6:.4g} um is finer than what the lenslets resolve: they blur it"
            )
    if size_m > seen_m:
        terminal.print_warning(f"subimages of masks above {seen_m * 1e3:.3g} mm overlap: choose a smaller size")


def _predict(name: str, bench: Bench) -> None:
    """Print the predicted accuracy of a mask and of the square."""
    from app.evaluation.mask_accuracy import predicted_accuracies, with_mask

    with terminal.progress_bar() as progress:
        found = predicted_accuracies(with_mask(bench, name), progress)
    headings = ["errors: RMS, rad", *(Path(name).name if mask == "image" else mask for mask in found)]
    cells = {figure: [f"{of_mask[figure]:.3g}" for of_mask in found.values()] for figure in found["square"]}
    notes = ["in the views inside the mask; nan: not determined; no unbiased estimate scatters less than the bound"]
    terminal.print_table(None, headings, [[figure, *each] for figure, each in cells.items()], notes)

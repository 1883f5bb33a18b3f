"""`svwfs reconstruct`: the wavefront of a frame in image files."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from app.commands import options, terminal
from app.errors import InputError
from app.files import require_suffix
from app.images import IMAGE_FORMATS, name_of
from app.progress import counted

_TURNED = 1e-3  # rad; by less, the axes are those of the camera

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from app.bench.config import Bench
    from app.measurement.offline_reconstructor import OfflineReconstructor
    from reconstruction.arrays import Floats
    from reconstruction.refinement import Round
    from reconstruction.wavefront import Wavefront


def reconstruct(
    frame: Annotated[Path, typer.Argument(help=f"Frame with the sample: {IMAGE_FORMATS}.")],
    *,
    reference: Annotated[Path, typer.Option(help="Frame without the sample.")],
    bench: options.Bench,
    out: Annotated[Path, typer.Option(help="NetCDF file to write.")],
    dark: Annotated[Path | None, typer.Option(help="Frame with the light off.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Picture of the views: PNG, PDF or SVG.")] = None,
    refine: Annotated[
        int, typer.Option(min=0, max=options.MOST_ROUNDS, help="Maximum rounds of refinement with the forward model.")
    ] = 0,
    order: options.Order = "noll",
    remove: options.Remove = None,
    table: Annotated[Path | None, typer.Option(help="CSV file of the Zernike coefficients of all views.")] = None,
    overwrite: options.Overwrite = False,
    setting: options.Set = None,
) -> None:
    """Reconstruct the wavefronts of one frame from image files.

    The Zernike coefficients are those of the pupil's circle or annulus, [pupil] in the bench, or else of the circle
    inscribed in the lattice. Of a file of many images, name one: film.tif[3], data.h5:/path/to/frames[3].

    Example: svwfs reconstruct frame.tif --reference reference.tif --dark dark.tif --bench bench.toml --out result.nc

    Example: svwfs reconstruct f.fits --reference r.fits --bench b.toml --out r.nc --order fringe --remove tilt,defocus
    """
    from app.measurement.estimator import mask_sentence, method_sentence
    from app.measurement.offline_reconstructor import OfflineReconstructor
    from app.results import zernike_table
    from app.results.coefficients import zernikes_of_views
    from app.results.dataset import result_dataset
    from app.results.figures import views_figure
    from app.results.result_file import write_results
    from app.results.run_summary import QualityTally
    from app.results.shown_wavefront import DisplayOptions, WavefrontDisplay
    from reconstruction.errors import ReconstructionError

    display = WavefrontDisplay()
    display.options = DisplayOptions(removed=zernike_table.modes_named(remove))
    loaded = options.load(bench, setting)
    reads = (*options.files_of_images(frame, reference, dark), *options.files_of_bench(bench, loaded))
    options.check_files(out, table, reads=reads, suffixes=(".nc",), plot=plot, overwrite=overwrite)
    if table is not None:
        require_suffix(table, ".csv")
    image, reference_image, dark_image = _read_images(frame, reference, dark, loaded.camera_model.bits)
    try:
        reconstructor = OfflineReconstructor(loaded, reference_image, dark=dark_image)
        wavefront, changes_rad = _refined(reconstructor, image, refine)
        quality, prepared = reconstructor.quality(image, wavefront), reconstructor.estimator().reconstructor
        is_live = loaded.reconstruction.refine and not refine
        notes = (
            mask_sentence(prepared, wavefront.sample),
            _size_note(loaded, image),
            "reconstruction.refine = true is for live frames: here give --refine N" * is_live,
        )
    except ReconstructionError as error:
        paths = {"frame": frame, "dark": dark}
        raise InputError(f"{paths.get(error.image) or reference}: {error}") from error
    files = {"frame": frame, "reference": reference, "dark": dark}
    names = {name: "" if path is None else name_of(path) for name, path in files.items()}
    zernikes, wavefront = zernikes_of_views(wavefront, order), display(wavefront)
    dataset = result_dataset(wavefront, quality, with_psf=True).assign_attrs(refinement_rounds=len(changes_rad))
    dataset = zernike_table.with_table(dataset, zernikes, wavefront.sensor).assign_attrs(removed=remove or "nothing")
    write_results(out, dataset, bench=reconstructor.bench, inputs=names)
    if table is not None:
        zernike_table.write_table(table, zernikes, wavefront.sensor)
    options.draw(plot, lambda: views_figure(wavefront))
    for note in filter(None, notes):
        terminal.remind(f"note: {note}")
    print_views(wavefront)
    if chosen := method_sentence(prepared):
        terminal.print_sentence(chosen)
    rotation_rad = 0.0 if reconstructor.bench.lattice is None else reconstructor.bench.lattice.rotation_rad
    _print_zernikes(zernikes, wavefront, f", without {remove}" if remove else "", rotation_rad)
    if refine:
        changes = ", ".join(f"{change_rad:.4f}" for change_rad in changes_rad)
        refined = f"refined in {counted(len(changes_rad), 'round')}, changing the wavefront by {changes} rad RMS"
        terminal.print_sentence(refined if changes else "not refined: it would not improve")
    tally = QualityTally()
    tally.take(quality)
    terminal.print_quality(tally)


def _refined(reconstructor: OfflineReconstructor, image: NDArray[Any], rounds: int) -> tuple[Wavefront, list[float]]:
    """Return the wavefront after some rounds of refinement, and by how much each changed it."""
    changes_rad: list[float] = []
    with terminal.progress_bar() if rounds else nullcontext(lambda *_: None) as progress:

        def note_round(step: Round) -> None:
            changes_rad.append(step.change_rad)
            progress("refining", len(changes_rad) / rounds)

        progress("modelling the bench", 0.0)
        return reconstructor.refined(image, rounds, seen=note_round), changes_rad


def _print_zernikes(zernikes: xr.Dataset, wavefront: Wavefront, without: str, rotation_rad: float) -> None:
    """Print the Zernike coefficients of the middle view, its RMS and PV in all units, and the pupil."""
    from app.results import zernike_table
    from app.results.figures import place_of_view

    field, sensor = wavefront.field, wavefront.sensor
    view, circle = (field.view_rows // 2, field.view_columns // 2), sensor.circle
    inside = circle.contains(sensor.lenslet_centers_m)
    valid = wavefront.displacement.valid
    place, size = place_of_view(field, *view), circle.in_words
    size = size if sensor.pupil.is_bounded else size.replace("pupil", "circle inscribed in the lattice:")
    turned = f"; lattice axes, turned by {rotation_rad:+.3f} rad from the camera's" * (abs(rotation_rad) > _TURNED)
    terminal.print_sentence(f"Zernike coefficients at {place}: {zernikes.attrs['order']}{turned}")
    terminal.print_table(
        None,
        ("mode", "nm", "error", "waves"),
        zernike_table.printed_rows(zernikes, view, sensor),
        (
            f"{size}, in which {(valid & inside).sum()} of the {valid.sum()} valid lenslets lie",
            f"at {place}{without}: {zernike_table.view_sentence(wavefront.views[view], sensor)}",
        ),
    )


def _read_images(
    frame: Path, reference: Path, dark: Path | None, bits: int
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any] | None]:
    """Read frame, reference and dark; `InputError` names one that does not go with the others."""
    from app.images import read_image

    frame_image, reference_image = read_image(frame), read_image(reference)
    dark_image = None if dark is None else read_image(dark)
    for path, image in ((frame, frame_image), (dark, dark_image)):
        if image is not None and image.shape != reference_image.shape:
            raise InputError(
                f"{path}: has {_size(image)} pixels (rows x columns), but the reference {reference} has"
                f" {_size(reference_image)}"
            )
    _check_scale(frame_image, frame, reference_image, reference, bits)
    _check_scale(reference_image, reference, frame_image, frame, bits)
    return frame_image, reference_image, dark_image


def _check_scale(image: NDArray[Any], path: Path, other: NDArray[Any], other_path: Path, bits: int) -> None:
    """Raise `InputError` if another image has more counts than this one's type, or the camera, allows."""
    import numpy as np

    from app.measurement.offline_reconstructor import full_scale_of
    from reconstruction.frame.pixels import PEAK_PERCENT

    most = full_scale_of(image, 64 if image.dtype.kind in "ui" else bits)
    if most < np.percentile(other, PEAK_PERCENT, method="lower") < np.inf:  # infinite ones are refused later
        raise InputError(
            f"{path}: holds {image.dtype} values up to {image.max():g}, but {other_path} {other.dtype} values up to"
            f" {other.max():g}: save both in the same form"
        )


def _size_note(bench: Bench, frame: NDArray[Any]) -> str:
    """Say if a frame has another size than the bench sets for its simulated camera."""
    shape = bench.frame_shape
    if shape is None or shape == frame.shape:
        return ""
    return f"the frame has {_size(frame)} pixels, the bench's camera {shape[0]} x {shape[1]}: is this its bench?"


def _size(image: NDArray[Any]) -> str:
    return " x ".join(str(length) for length in image.shape)


def print_views(wavefront: Wavefront) -> None:
    """Print RMS with error bar and PV of every view, valid lenslets, and the assumed sample."""
    from app.measurement.measurement import sample_sentence
    from app.results.dataset import rotation_of
    from app.results.run_summary import rms_over_lenslets, rms_text
    from reconstruction.wavefront import peak_to_valley, rms

    def cell(view: Floats, noise_rad: float) -> str:
        """RMS and PV of a view, rad; no PV if the wavefront is below the noise."""
        rms_rad = float(rms(view))
        text = rms_text(rms_rad, noise_rad)
        return text if rms_rad < noise_rad else f"{text}\nPV {peak_to_valley(view):.2f}"

    noise_rad = rms_over_lenslets(wavefront.sigma())
    cells = ((cell(*each) for each in zip(*row, strict=True)) for row in zip(wavefront.views, noise_rad, strict=True))
    terminal.print_by_view(wavefront.field, "RMS +- error bar and PV (rad) at each field position", cells)
    displacement = wavefront.displacement
    terminal.print_sentence("; ".join(displacement.summary))
    terminal.print_sentence(f"assumed: {sample_sentence(wavefront.sample, wavefront.field)}")
    rotation = rotation_of(wavefront)
    if rotation is not None:
        terminal.print_rotation(rotation, is_rotating=rotation.contradicts_layers)

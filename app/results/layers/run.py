"""`svwfs layers`: distances and phase maps of the sample's layers, from one frame."""

from pathlib import Path

import xarray as xr

from app.errors import InputError
from app.files import check_outputs, check_suffix
from app.progress import Progress
from app.recording.folder import parts_of
from app.results.dataset import write_results
from app.results.layers.dataset import Origin, layers_dataset, ratio_at
from app.results.layers.figure import plot_layers
from app.results.layers.measured_frame import measured_frame
from app.results.plot import check_plot_path
from reconstruction.layers.layer_search import find_layers
from reconstruction.runtime.threads import one_blas_thread

_MOST = 2


def find(  # noqa: PLR0913 - the options of the command
    source: Path,
    *,
    count: int,
    distances_m: tuple[float, ...],
    origin: Origin,
    frame: int,
    out: Path,
    plot: Path | None,
    overwrite: bool,
    progress: Progress,
) -> xr.Dataset:
    """Find the layers in a frame of a recording or a results file, and write them; `InputError` says what is wrong."""
    check_suffix(out, ".nc")
    check_outputs([out, plot], inputs=parts_of(source) if source.is_dir() else [source], overwrite=overwrite)
    if plot is not None:
        check_plot_path(plot)
    if len(distances_m) > _MOST:
        raise InputError("give at most two distances")
    if len(set(distances_m)) < len(distances_m):
        raise InputError("two layers need two different distances")
    if count == _MOST and len(distances_m) == 1:
        raise InputError("two layers need two distances, or none")
    progress("reconstructing the frame", 0.0)
    with one_blas_thread():
        bench, equations = measured_frame(source, frame)
        ratios = tuple(ratio_at(distance_m, origin, bench) for distance_m in distances_m)
        progress("finding the layers", 0.3)
        found = layers_dataset(find_layers(equations, count, at=ratios), bench, origin)
    progress("writing", 0.9)
    write_results(out, found, bench=bench, inputs={"source": source.name, "frame": str(frame)})
    if plot is not None:
        plot_layers(found, plot)
    progress("writing", 1.0)
    return found


def summary(found: xr.Dataset) -> list[str]:
    """Distances, and what explains the displacements, in sentences."""
    origin = found.attrs["distances_from"]
    lines = []
    for at_m, sigma_m in zip(found["distance_m"].values, found["distance_sigma_m"].values, strict=True):
        error = f" +- {sigma_m * 1e3:.2g}" if sigma_m == sigma_m else ""  # noqa: PLR0124 - NaN if it was given
        lines.append(f"layer at {at_m * 1e3:.1f}{error} mm from the {origin}")
    for name, misfit, chi_square in zip(
        found["model"].values, found["model_misfit"].values, found["model_chi_square"].values, strict=True
    ):
        lines.append(
            f"{name}: {100 * misfit:.2g} % of the displacements unexplained, reduced chi-square {chi_square:.2f}"
        )
    lines.append(f"verdict: {found.attrs['verdict']}")
    return lines

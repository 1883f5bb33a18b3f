"""The work of `svwfs layers`."""

from dataclasses import dataclass
from pathlib import Path

import xarray as xr

from app.errors import InputError
from app.files import check_outputs, check_suffix
from app.progress import Progress
from app.recording.folder import parts_of
from app.results.figures import check_plot_path
from app.results.layers import Origin, distance_in_words, layers_dataset, plot_layers, ratio_at
from app.results.result_file import write_results
from app.results.sources import measured_frame
from reconstruction.layers.layer_search import find_layers
from reconstruction.runtime.threads import one_blas_thread

_MOST = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Source, layers and outputs of a search."""

    source: Path  # file of results, or folder of a recording
    frame: int
    count: int  # of layers to look for
    distances_m: tuple[float, ...]  # known ones; then none is looked for
    origin: Origin  # of distances
    out: Path
    plot: Path | None
    overwrite: bool

    def __post_init__(self) -> None:
        if len(self.distances_m) > _MOST:
            raise InputError("give at most two distances")
        if len(set(self.distances_m)) < len(self.distances_m):
            raise InputError("two layers need two different distances")
        if self.count == _MOST and len(self.distances_m) == 1:
            raise InputError("two layers need two distances, or none")


def find(plan: Plan, progress: Progress) -> xr.Dataset:
    """Find the layers in a frame of a recording or a results file, and write them; `InputError` says what is wrong."""
    source = plan.source
    check_suffix(plan.out, ".nc")
    inputs = parts_of(source) if source.is_dir() else [source]
    check_outputs([plan.out, plan.plot], inputs=inputs, overwrite=plan.overwrite)
    if plan.plot is not None:
        check_plot_path(plan.plot)
    progress("reconstructing the frame", 0.0)
    with one_blas_thread():
        bench, equations = measured_frame(source, plan.frame)
        ratios = tuple(ratio_at(distance_m, plan.origin, bench) for distance_m in plan.distances_m)
        progress("finding the layers", 0.3)
        found = layers_dataset(find_layers(equations, plan.count, at=ratios), bench, plan.origin)
    progress("writing", 0.9)
    write_results(plan.out, found, bench=bench, inputs={"source": source.name, "frame": str(plan.frame)})
    if plan.plot is not None:
        plot_layers(found, plan.plot)
    progress("writing", 1.0)
    return found


def summary(found: xr.Dataset) -> list[str]:
    """Distances, and what explains the displacements, in sentences."""
    origin = found.attrs["distances_from"]
    at = zip(found["distance_m"].values, found["distance_sigma_m"].values, strict=True)
    lines = ["layer " + distance_in_words(*each, origin).replace("\N{PLUS-MINUS SIGN}", "+-") for each in at]
    if found.attrs["verdict"].startswith("nothing"):
        lines = []
    for name, misfit, chi_square in zip(
        found["model"].values, found["model_misfit"].values, found["model_chi_square"].values, strict=True
    ):
        share = float(f"{100 * misfit:.2g}")
        reduced = "below 0.01" if chi_square < 0.005 else f"{chi_square:.2f}"
        lines.append(f"{name}: {share:g} % of the displacements unexplained, reduced chi-square {reduced}")
    lines.append("; but ".join(filter(None, (f"verdict: {found.attrs['verdict']}", found.attrs["doubt"]))))
    return lines

"""The work of `svwfs field`."""

from dataclasses import dataclass
from pathlib import Path

import xarray as xr

from app.errors import InputError
from app.files import check_outputs
from app.progress import Progress
from app.recording.folder import parts_of
from app.results.field_coefficients import field_dataset, plot_field, strongest, table_names, table_rows, write_table
from app.results.figures import check_plot_path
from app.results.result_file import write_results
from app.results.sources import read_fit
from reconstruction.errors import ReconstructionError
from reconstruction.field_coefficients import field_coefficients
from reconstruction.runtime.threads import one_blas_thread
from reconstruction.settings import PupilBasis

_FORMATS = (".nc", ".csv")


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Source, outputs and modes of a map over the field."""

    source: Path  # file of results, or folder of a recording
    frame: int
    basis: PupilBasis
    order: int | None  # highest degree of the pupil modes; None: that of the fit
    field_order: int | None  # highest radial order of the double Zernikes; None: that of the field modes
    positions: int  # across the field
    modes: tuple[int, ...]  # in the picture; the strongest if empty
    out: Path
    plot: Path | None
    overwrite: bool


def map_field(plan: Plan, progress: Progress) -> xr.Dataset:
    """Write the coefficients of one frame over the field, and return them; `InputError` says what is wrong."""
    source = plan.source
    inputs = parts_of(source) if source.is_dir() else [source]
    check_outputs([plan.out, plan.plot], inputs=inputs, overwrite=plan.overwrite)
    if plan.out.suffix.lower() not in _FORMATS:
        raise InputError(f"{plan.out}: give a name that ends in one of {', '.join(_FORMATS)}")
    if plan.plot is not None:
        check_plot_path(plan.plot)
    if plan.field_order is not None and plan.basis != "zernike":
        raise InputError("--field-order is that of double Zernikes: leave it out with --basis legendre")
    progress("reconstructing the frame", 0.0)
    with one_blas_thread():
        bench, fit = read_fit(source, plan.frame)
        try:
            found = field_coefficients(fit, plan.basis, plan.order)
            maps = field_dataset(found, bench.sensor, bench.field, plan.positions, plan.field_order)
        except ReconstructionError as error:
            raise InputError(f"{source}: {error}") from error
    _require_modes(plan.modes, maps)
    progress("writing", 0.9)
    if plan.out.suffix.lower() == ".csv":
        x_m = maps["x"].values
        write_table(plan.out, table_names(found), table_rows(found, bench.field, x_m, x_m))
    else:
        write_results(plan.out, maps, bench=bench, inputs={"source": source.name, "frame": str(plan.frame)})
    if plan.plot is not None:
        plot_field(maps, plan.modes or strongest(maps), plan.plot)
    progress("writing", 1.0)
    return maps


def summary(maps: xr.Dataset) -> list[str]:
    """Return the strongest coefficients in sentences, as mean and range over the field."""
    lines = []
    for number in strongest(maps):
        of_mode = maps.sel(mode=number)
        values, sigma = of_mode["coefficient"], float(of_mode["coefficient_sigma"].mean())
        lines.append(
            f"{of_mode['name'].item()}: mean {float(values.mean()):+.3f} rad,"
            f" {float(values.min()):+.3f} ... {float(values.max()):+.3f} over the field, error {sigma:.2g} rad"
        )
    if (share := maps.attrs["known_share"]) < 1:
        lines.append(f"{100 * (1 - share):.0f} % of the lenslets in the pupil are unknown: the modes bridge them")
    return lines


def _require_modes(modes: tuple[int, ...], maps: xr.Dataset) -> None:
    first, last = (int(maps["mode"].values[at]) for at in (0, -1))
    for mode in modes:
        if not first <= mode <= last:
            raise InputError(f"--mode {mode}: the {maps.attrs['basis']} modes of this result are {first} ... {last}")

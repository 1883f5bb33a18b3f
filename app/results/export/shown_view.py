"""The wavefronts as shown in the window, as a file of results."""

from dataclasses import replace
from pathlib import Path

from app.bench.config import Bench
from app.results.dataset import result_dataset, write_results
from reconstruction.wavefront import Wavefront


def write_shown(path: Path, shown: Wavefront, bench: Bench, *, options: str) -> None:
    """Write a wavefront with the display `options` applied, which the attribute `display` names, as NetCDF."""
    bench = replace(bench, field=shown.field)  # the display may have chosen other views
    write_results(path, result_dataset(shown), bench=bench, inputs={"display": options or "as measured"})

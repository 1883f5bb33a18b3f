"""Results as text on the terminal."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table

from reconstruction.registration import Outcome
from reconstruction.wavefront import Wavefront, peak_to_valley, rms


def print_views(wavefront: Wavefront) -> None:
    """Print RMS and PV of every view, as the views lie in the field, and what became of the lenslets."""
    field = wavefront.field
    table = Table(title="RMS / PV (rad) of the wavefront at each field position")
    table.add_column("y \\ x (mm)", justify="right")
    for x_m in field.view_x_m:
        table.add_column(f"{x_m * 1e3:+.2f}", justify="right")
    for y_m, row in zip(field.view_y_m, wavefront.views, strict=True):
        table.add_row(f"{y_m * 1e3:+.2f}", *(f"{rms(view):.3f} / {peak_to_valley(view):.2f}" for view in row))
    console = Console()
    console.print(table)
    console.print(lenslet_summary(wavefront))


def lenslet_summary(wavefront: Wavefront) -> str:
    """Say how many lenslets yield a slope and why the others do not: "223 of 225 lenslets valid; 2 dark"."""
    outcome = wavefront.displacement.outcome
    lost = (
        f"{count} {Outcome(code).name.lower().replace('_', ' ')}"
        for code, count in zip(*np.unique(outcome, return_counts=True), strict=True)
        if code != Outcome.CONVERGED
    )
    return "; ".join([f"{np.count_nonzero(wavefront.displacement.valid)} of {outcome.size} lenslets valid", *lost])

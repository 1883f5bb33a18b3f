"""The benchmark as tables on the terminal and as JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path

import rich.table
from rich import box
from rich.console import Console

from app.evaluation.benchmark.ours import OURS
from app.evaluation.benchmark.run import Json
from app.files import atomic_write


def write_benchmark(result: Json, path: Path) -> None:
    """Write everything that was measured."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(result, indent=2) + "\n")


def print_benchmark(result: Json) -> None:
    """Print times and residuals beside one another, and the growth."""
    console = Console(width=max(Console().width, 100))  # numbers cut short are of no use, in a pipe neither
    machine = result["machine"]
    console.print(f"{machine['processor']}, {machine['cores']} cores; the same noisy frame for all", highlight=False)
    table = _table("one frame", "median, ms", "best, ms", "over ours", "residual, rad", "noise-free")
    ours_s = result["times"][OURS]["median_s"]
    for name, times in result["times"].items():
        numbers = (times["median_s"] * 1e3, times["best_s"] * 1e3, times["median_s"] / ours_s)
        residuals = (result["residuals_rad"][kind].get(name, math.nan) for kind in ("noisy", "noise_free"))
        table.add_row(name, *(f"{number:.2f}" for number in numbers), *(f"{number:.3f}" for number in residuals))
    console.print(table)
    for name, why in result["missing"].items():
        console.print(f"missing: {name}: {why}", highlight=False)
    console.print(f"{result['frames_per_s']:.0f} frames/s in a loop (quadratic, warm)", highlight=False)
    zonal, forward = result["zonal"], result["forward"]
    console.print(
        f"zonal solve of all views {zonal['ours_s'] * 1e3:.3f} ms, "
        f"bare SciPy splu {zonal['scipy_splu_s'] * 1e3:.3f} ms",
        highlight=False,
    )
    hcipy = f", HCIPy {forward['hcipy_s_per_point'] * 1e3:.1f} ms" if "hcipy_s_per_point" in forward else ""
    console.print(f"forward model {forward['ours_s_per_point'] * 1e3:.2f} ms an object point{hcipy}", highlight=False)
    console.print(_growth(result))


def _growth(result: Json) -> rich.table.Table:
    table = _table(
        "lenslets",
        *("Q", "px", "register", "zonal", "modal", "all, ms", "each, us", "prepare, s", "peak, MB"),
    )
    for each in [*result["growth"], *([result["four_k"]] if "four_k" in result else [])]:
        milliseconds = (each[f"{stage}_s"] * 1e3 for stage in ("register", "zonal", "modal", "frame"))
        table.add_row(
            f"{each['lenslets']} x {each['lenslets']}",
            str(each["field_modes"]),
            str(each["frame_px"]),
            *(f"{number:.2f}" for number in milliseconds),
            f"{each['per_lenslet_us']:.1f}",
            f"{each['prepare_s']:.1f}",
            f"{each['peak_memory_mb']:.0f}",
        )
    return table


def _table(first: str, *others: str) -> rich.table.Table:
    table = rich.table.Table(box=box.SIMPLE, padding=(0, 1))
    table.add_column(first, no_wrap=True)
    for name in others:
        table.add_column(name, justify="right")
    return table

"""The benchmark as tables on the terminal."""

import math
from collections.abc import Iterator
from typing import Any

from app.evaluation.benchmark.ours import OURS
from app.evaluation.benchmark.run_benchmark import Json
from app.evaluation.study_tables import print_line, print_table

_WIDTH = 100


def print_benchmark(result: Json) -> None:
    """Print times and residuals of all contestants, and the growth."""
    machine, zonal, forward = result["machine"], result["zonal"], result["forward"]
    print_line(f"{machine['processor']}, {machine['cores']} cores; the same noisy frame for all")
    headings = ["one frame", "median, ms", "best, ms", "over ours", "residual, rad", "noise-free"]
    print_table(None, headings, _contestants(result), width=_WIDTH)
    for name, problem in result["missing"].items():
        print_line(f"missing: {name}: {problem}")
    print_line(f"{result['frames_per_s']:.0f} frames/s in a loop (quadratic, warm)")
    ours_ms, scipy_ms = zonal["ours_s"] * 1e3, zonal["scipy_splu_s"] * 1e3
    print_line(f"zonal solve of all views {ours_ms:.3f} ms, bare SciPy splu {scipy_ms:.3f} ms")
    layer = result["layer"]
    print_line(
        f"one layer at a known distance {layer['known_s'] * 1e3:.1f} ms, search for layers {layer['search_s']:.2f} s"
    )
    hcipy = f", HCIPy {forward['hcipy_s_per_point'] * 1e3:.1f} ms" if "hcipy_s_per_point" in forward else ""
    print_line(f"forward model {forward['ours_s_per_point'] * 1e3:.2f} ms per object point{hcipy}")
    headings = ["lenslets", "Q", "px", "register", "zonal", "modal", "all, ms", "each, us", "prepare, s", "peak, MB"]
    sizes = [*result["growth"], *([result["four_k"]] if "four_k" in result else [])]
    print_table(None, headings, map(_size, sizes), width=_WIDTH)


def _contestants(result: Json) -> Iterator[list[str]]:
    ours_s = result["times"][OURS]["median_s"]
    for name, times in result["times"].items():
        numbers = (times["median_s"] * 1e3, times["best_s"] * 1e3, times["median_s"] / ours_s)
        residuals = (result["residuals_rad"][kind].get(name, math.nan) for kind in ("noisy", "noise_free"))
        yield [name, *(f"{number:.2f}" for number in numbers), *(f"{number:.3f}" for number in residuals)]


def _size(times: dict[str, Any]) -> list[str]:
    return [
        f"{times['lenslets']} x {times['lenslets']}",
        str(times["field_modes"]),
        str(times["frame_px"]),
        *(f"{times[f'{stage}_s'] * 1e3:.2f}" for stage in ("register", "zonal", "modal", "frame")),
        f"{times['per_lenslet_us']:.1f}",
        f"{times['prepare_s']:.1f}",
        f"{times['peak_memory_mb']:.0f}",
    ]

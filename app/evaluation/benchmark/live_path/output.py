"""The figures of the live path as a table on the terminal, and what of them misses its limit."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from app.evaluation.benchmark.live_path.figures import LiveFigures, Verdict
from app.run_facts import machine_facts, versions
from app.timing import Summary

_COLUMNS = 80  # that the table needs


def print_live(figures: LiveFigures) -> None:
    """Print every figure beside what is asked of it."""
    console, machine = Console(width=max(Console().width, _COLUMNS)), machine_facts()
    camera, sensor = figures.plan.bench.camera_model, figures.plan.bench.sensor
    what = (
        f"{camera.rows} x {camera.columns} pixels, {sensor.lenslet_rows} x {sensor.lenslet_columns} lenslets",
        f"{1 / camera.exposure_s:.1f} frames/s",
        "recorded" if figures.recording else "not recorded",
        f"{figures.window.seconds:.0f} s after a warm-up",
    )
    where = (
        "the window was open on a display" if figures.is_seen else "there is no display: the window was drawn unseen"
    )
    for line in (f"{machine['processor'] or machine['system']}, {machine['cores']} cores", ", ".join(what), where):
        console.print(line, highlight=False, soft_wrap=True)
    console.print(_table(figures))
    console.print("Times are median / 99 % / longest.", highlight=False)
    if figures.recording is not None and figures.recording.problem:
        console.print(f"The recording has ended early: {figures.recording.problem}", highlight=False, soft_wrap=True)


def live_json(figures: LiveFigures) -> dict[str, Any]:
    """Return what is written as JSON: the live path's figures, beside the computer and the libraries."""
    return {"live": figures.as_dict(), "machine": machine_facts(), "versions": versions()}


def missed(figures: LiveFigures) -> list[str]:
    """Say of every figure that misses its limit what it is, and what was asked."""
    return [
        f"{name} is {each.value:.3g}, asked {each.asked}"
        for name, each in figures.verdicts().items()
        if not each.is_met
    ]


def _table(figures: LiveFigures) -> Table:
    table = Table(box=box.SIMPLE, padding=(0, 1), pad_edge=False)
    for column in ("live", "measured", "asked", ""):
        table.add_column(column, no_wrap=True)
    verdicts, window, bare = figures.verdicts(), figures.window, figures.bare
    frames, times = window.frames, window.timings.summary()

    def row(name: str, measured: str, verdict: Verdict | None = None) -> None:
        said = ("", "") if verdict is None else (verdict.asked, _in_words(verdict))
        table.add_row(name, measured, *said)

    row("frames acquired", f"{frames.acquired}")
    row("reconstructed", f"{frames.reconstructed}: {100 * frames.share:.2f} %", verdicts["share"])
    row("lost by the camera", f"{frames.lost}", verdicts["lost"])
    row("passed over, newer there", f"{frames.passed_over}")
    row("without a wavefront", f"{frames.failed}")
    row("camera to result", _milliseconds(times["to_result"]), verdicts["to_result_p99_s"])
    row("camera to screen", _milliseconds(times["to_screen"]))
    row("window redrawn", f"{window.redrawn_hz:.1f} /s", verdicts["redrawn_hz"])
    if figures.recording is not None:
        row("frame written to the disk", _milliseconds(times["record"]), verdicts["record_p99_s"])
        row("recorded, with warm-up", f"{figures.recording.frames}", verdicts["recording_problems"])
    row(f"memory, last {figures.plan.memory_s:.0f} s", _memory(figures), verdicts.get("memory_growth"))
    row(f"rate without window, {bare.seconds:.0f} s", f"{bare.rate_hz:.2f} /s")
    row("rate with it", f"{window.rate_hz:.2f} /s: {100 * figures.rate_ratio:.1f} %", verdicts["rate_ratio"])
    row("first wavefront after", f"{window.first_wavefront_s:.1f} s", verdicts["first_wavefront_s"])
    return table


def _in_words(verdict: Verdict) -> str:
    return "[green]met[/]" if verdict.is_met else "[red]missed[/]"


def _milliseconds(times: Summary) -> str:
    if not times.count:
        return "none"
    p50_ms, p99_ms, max_ms = (1e3 * seconds for seconds in (times.p50_s, times.p99_s, times.max_s))
    return f"{p50_ms:.1f} / {p99_ms:.1f} / {max_ms:.1f} ms"


def _memory(figures: LiveFigures) -> str:
    begin_mb, end_mb = figures.window.memory_mb
    if begin_mb is None or end_mb is None or figures.memory_growth is None:
        return "not told by this system"
    return f"{begin_mb:.0f} > {end_mb:.0f} MB, {100 * figures.memory_growth:+.2f} %"

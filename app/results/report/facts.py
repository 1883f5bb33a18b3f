"""Facts of a recording for the first page of its report, a line each."""

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import datetime
from typing import Any

from app.bench.config import Bench
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.progress import counted
from app.recording.frame_lines import FrameLine
from app.results.report.summary import Summary

Fact = tuple[str, str]  # label and text
_MOST_DOUBTS = 4


def facts(summary: Summary) -> list[Fact]:
    """Return the facts of a recording, without those that it does not contain."""
    run, lines, bench = summary.recording.run, summary.lines, summary.bench
    camera, light, stage = (_section(run, "devices", name) for name in ("camera", "light", "stage"))
    doubts = [] if summary.statistics is None else summary.statistics.quality.sentences
    said = [
        ("recorded", _when(summary)),
        ("frames", _counts(summary)),
        *[("", f"{count} of them: {problem}") for problem, count in summary.problems.most_common(2)],
        *[("doubtful", sentence) for sentence in doubts[:_MOST_DOUBTS]],
        ("camera", _camera(summary, camera, bench)),
        ("exposure", _exposure(lines, camera)),
        ("light", _light(lines, light)),
        ("mask", str(stage.get("mask", bench.simulation.source.mask))),
        *_of_calibration(summary),
        ("method", _method(bench, summary)),
        ("speed", _speed(_section(run, "timings"))),
        ("software", _software(run)),
    ]
    return [(name, text) for name, text in said if text]


def _section(tree: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return a section of `run.json`, empty if it is missing or damaged."""
    for name in names:
        tree = tree.get(name, {})
        if not isinstance(tree, dict):
            return {}
    return tree


def _when(summary: Summary) -> str:
    recording = summary.recording
    parts = []
    with suppress(KeyError, ValueError):  # missing, or damaged
        began = datetime.fromisoformat(str(recording.run["began"]))
        parts.append(f"{began:%Y-%m-%d %H:%M:%S} {began.tzname() or ''}".strip())
    parts.append(f"{summary.lines[-1].host_time_s - summary.lines[0].host_time_s:.1f} s from first to last frame")
    if command := recording.run.get("command"):
        parts.append(f"by svwfs {command}")
    if not recording.is_complete:
        parts.append("not finished: it grows, or svwfs recover finishes it")
    if note := recording.run.get("note"):
        parts.append(f"note: {note}")
    if recording.ended_early:
        parts.append(f"ended early: {recording.ended_early}")
    return "; ".join(parts)


def _counts(summary: Summary) -> str:
    lines, whole = summary.lines, len(summary.recording)
    acquired = _section(summary.recording.run, "frames").get("acquired")
    some = "" if len(lines) == whole else f"{lines[0].index} ... {lines[-1].index} of "
    gap_s = sum(line.gap_s for line in lines)
    with_wavefront = 0 if summary.statistics is None else len(summary.statistics.frames)
    return (
        f"{some}{whole} recorded{'' if acquired is None else f' of {acquired} acquired'};"
        f" {sum(line.lost for line in lines)} lost by the camera;"
        f"{f' it stood for {gap_s:.1f} s;' if gap_s else ''}"
        f" {with_wavefront} of {summary.sampled} reconstructed again have a wavefront"
    )


def _camera(summary: Summary, camera: dict[str, Any], bench: Bench) -> str:
    rows, columns = summary.recording.pixels(summary.lines[0].index).shape
    size = f"{columns} x {rows} pixels of {bench.sensor.pixel_pitch_m * 1e6:g} µm"
    more = [f"{name} {camera[name]}" for name in camera if "temperature" in name.lower()][:1]
    return ", ".join([str(camera.get("name", bench.camera.driver)), size, *more])


def _exposure(lines: list[FrameLine], camera: dict[str, Any]) -> str:
    parts = [f"{_range((line.exposure_s for line in lines), 1e3)} ms"]
    if "amplifier" in camera:
        parts.append(f"{camera['amplifier']} amplifier")
    if "readout_speed" in camera:
        parts.append(f"readout speed {camera['readout_speed']}")
    return ", ".join([*parts, f"em gain {_range(line.em_gain for line in lines)}"])


def _light(lines: list[FrameLine], light: dict[str, Any]) -> str:
    current = _range((line.light_current_a for line in lines if line.light_current_a is not None), 1e3)
    parts = [str(light["name"])] if "name" in light else []
    parts += [f"{current} mA"] if current else []
    if any(line.is_light_on is False for line in lines):
        parts.append("partly off")
    return ", ".join(parts)


def _of_calibration(summary: Summary) -> Iterator[Fact]:
    calibration = summary.calibration
    if calibration is None:
        yield "reference", "none: these frames have no calibration"
        return
    several = f"; the first of {summary.calibrations} calibrations" * (summary.calibrations > 1)
    yield "dark", "none" if calibration.dark is None else _average(calibration.dark)
    yield "reference", _average(calibration.reference) + several
    yield "noise", _noise(calibration)
    sensor, lattice = calibration.bench.sensor, calibration.lattice
    lies = f"centre ({lattice.center_x_px:.2f}, {lattice.center_y_px:.2f}) px"
    lies += f", turned by {lattice.rotation_rad * 1e3:+.2f} mrad"
    lenslets = f"{sensor.lenslet_columns} x {sensor.lenslet_rows} lenslets"
    yield "lattice", f"{lenslets}, pitch {lattice.pitch_px:.4f} px, {lies}"


def _average(average: Average) -> str:
    gain = f", em gain {average.em_gain:g}" * (average.em_gain != 1)
    return f"mean of {counted(average.frames)} of {average.exposure_s * 1e3:g} ms{gain}"


def _noise(calibration: Calibration) -> str:
    noise = calibration.noise
    if noise is None:
        return "unknown from dark and reference; error bars from the misfit"
    return (
        f"{noise.counts_per_electron:.3g} counts per electron, read noise {noise.read_noise_counts:.3g} counts,"
        " from dark and reference"
    )


def _method(bench: Bench, summary: Summary) -> str:
    registration, reconstruction = bench.registration, bench.reconstruction
    parts: list[str] = [registration.method]
    if registration.method == "gauss_newton":
        parts.append(f"warp {registration.warp or 'automatic'}")
    parts.append(reconstruction.method)
    if reconstruction.method == "modal":
        modes = reconstruction.pupil_modes
        parts.append(f"{reconstruction.basis}, {modes or 'automatic number of'} pupil modes")
    if summary.statistics is not None and summary.statistics.refined:
        parts.append(f"refined {summary.statistics.refined} of {len(summary.statistics.frames)}")
    return ", ".join(parts)


def _speed(timings: dict[str, Any]) -> str:
    wanted = {"register": "registration", "reconstruct": "reconstruction", "to_result": "exposure to result"}
    said = []
    for stage, name in wanted.items():
        p50_s, p99_s = (_section(timings, stage).get(which) for which in ("p50_s", "p99_s"))
        if isinstance(p50_s, float) and isinstance(p99_s, float):
            said.append(f"{name} {p50_s * 1e3:.1f} ({p99_s * 1e3:.1f}) ms")
    return ", ".join(said) + ": median (99 %)" * bool(said)


def _software(run: dict[str, Any]) -> str:
    versions, machine = _section(run, "versions"), _section(run, "machine")
    parts = [f"{name} {versions[name]}" for name in ("svwfs", "python", "numpy") if name in versions]
    if "system" in machine:
        parts.append(f"{machine['system']}, {machine.get('cores', '?')} cores")
    return ", ".join(parts)


def _range(values: Iterable[float], factor: float = 1.0) -> str:
    """The value, or the smallest and the largest; empty without any."""
    known = [value * factor for value in values]
    if not known:
        return ""
    least, most = min(known), max(known)
    return f"{least:.4g}" if math.isclose(least, most, rel_tol=1e-6) else f"{least:.4g} ... {most:.4g}"

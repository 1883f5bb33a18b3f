"""Trials of the routines before a measurement: lattices found, and auto-exposure from any start.

Lattices are the bench's, random ones, and those of reference frames from a folder; a faint frame has 200 electrons in
its brightest pixel, dead lenslets and uneven light. Auto-exposure runs on `simulated_devices.exposure_bench`, which
takes no time. The right exposures cover the camera's whole range with both ends, where the routine must change the
light instead.
"""

import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from app.bench.config import Bench, load_bench
from app.bench.imaging_model import by_pixel
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames, simulating
from app.evaluation.studies import CaseResult
from app.evaluation.study.estimators import camera
from app.evaluation.study_kinds import TrialStudy, trial
from app.images import read_image
from app.measurement.auto_exposure import FILL, MOST_FRAMES, TOLERANCE, auto_expose
from app.measurement.routines import UNWATCHED, RoutineError
from app.progress import Progress
from drivers.interface import Range
from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Lattice, Sensor
from reconstruction.lattice.search import Survey, survey
from simulated_devices.exposure_bench import PITCH_PX, LampScene, exposure_bench, spots, squares
from simulated_devices.settings import Mask, exposure_range_s

_LATTICE_LIMITS = {"centre (px)": 0.1, "pitch (px)": 0.02, "rotation (mrad)": 0.2}
_FAINT_FACTOR = 2.0  # on the limits
_LONGEST_S, _TIMED_PIXELS = 2.0, 512 * 512
_CLEAN_PEAK, _FAINT_PEAK_E, _DEAD_SHARE = 1e4, 200.0, 0.1
_DIMMEST = 0.4  # share of the light in the dimmest corner

_MASKS: tuple[Mask, ...] = ("square", "stars")
_BORDER = 1  # rings of lenslets that the frame's edge cuts
_ROOM = 1.4  # pitches for them, both sides together; with two or more, further lenslets would lie whole on the frame
_CENTER_PX, _PITCH, _ROTATION_RAD = 3.0, 0.008, 0.01  # largest deviation of a random lattice


@dataclass(frozen=True, slots=True, eq=False)
class _Reference:
    """A reference frame with its true lattice."""

    case: str
    name: str
    light: Image  # without noise, (row, column), any unit
    lattice: Lattice
    bench: Bench
    seed: int


def calibration_trials(frames: Path | None = None) -> TrialStudy:
    """Return the study; the folder `frames` has a bench.toml and *_reference.tif of its lattice."""
    title = "Lattices found: how far from the truth"
    return TrialStudy(name="calibration", title=title, measure=partial(_calibrate, frames))


def _calibrate(folder: Path | None, bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    for done, seed in enumerate(seeds):
        references = [*_from_folder(folder, seed), *_unchanged(bench, seed), *_random(bench, seed)]
        for index, reference in enumerate(references):
            progress(f"{reference.case}, {reference.name}", (done + index / len(references)) / len(seeds))
            if seed == 0 or "random" in reference.case:  # without noise the others never change
                yield _lattice_trial(reference, reference.light * (_CLEAN_PEAK / reference.light.max()), None)
            yield _lattice_trial(reference, *_faint(reference))


def _from_folder(folder: Path | None, seed: int) -> Iterator[_Reference]:
    if folder is None:
        return
    paths = sorted(folder.glob("*_reference.tif"))
    if not paths:
        raise InputError(f"{folder}: holds no *_reference.tif")
    bench = load_bench(folder / "bench.toml")
    for path in paths:
        light = np.asarray(read_image(path), np.float32)
        yield _Reference(path.name, f"seed {seed}", light, bench.design_lattice(*light.shape), bench, seed)


def _unchanged(bench: Bench, seed: int) -> Iterator[_Reference]:
    for mask in _MASKS:
        light = NoiseFreeFrames(bench).reference(mask)
        lattice = bench.design_lattice(*light.shape)
        yield _Reference(f"the bench's lattice, {mask}", f"seed {seed}", light, lattice, bench, seed)


def _random(bench: Bench, seed: int) -> Iterator[_Reference]:
    """Frames with a random lattice each, whose edge cuts a ring of lenslets."""
    rng = np.random.default_rng(seed)
    sensor, pitch_px = bench.sensor, bench.sensor.lenslet_pitch_px
    rows, columns = (int((count + _ROOM) * pitch_px) for count in (sensor.lenslet_rows, sensor.lenslet_columns))
    for mask in _MASKS:
        lattice = Lattice(
            center_x_px=(columns - 1) / 2 + rng.uniform(-_CENTER_PX, _CENTER_PX),
            center_y_px=(rows - 1) / 2 + rng.uniform(-_CENTER_PX, _CENTER_PX),
            pitch_px=pitch_px * (1 + rng.uniform(-_PITCH, _PITCH)),
            rotation_rad=rng.uniform(-_ROTATION_RAD, _ROTATION_RAD),
        )
        changed = simulating(bench, border_lenslets=_BORDER)
        changed = replace(changed, lattice=lattice, camera=replace(bench.camera_model, rows=rows, columns=columns))
        light = NoiseFreeFrames(changed).reference(mask)
        yield _Reference(f"random lattices, {mask}", f"seed {seed}", light, lattice, changed, seed)


def _faint(reference: _Reference) -> tuple[Image, Floats]:
    """The camera's frame, counts, and 1 for living, 0 for dead lenslets (lenslet_row, lenslet_column)."""
    sensor, ring = reference.bench.sensor, _BORDER + 1
    shape = sensor.lenslet_rows + 2 * ring, sensor.lenslet_columns + 2 * ring
    alive = (np.random.default_rng(reference.seed).random(shape) >= _DEAD_SHARE).astype(np.float64)
    uneven = np.add.outer(*(np.linspace(0.5, _DIMMEST / 2, count) for count in shape))
    light = reference.light * by_pixel(alive * uneven, reference.lattice, *reference.light.shape)
    electrons = light * (_FAINT_PEAK_E / light.max())
    return camera(reference.bench).exposed(electrons, reference.seed, 0), alive[ring:-ring, ring:-ring]


def _lattice_trial(reference: _Reference, light: Image, alive: Floats | None) -> CaseResult:
    """Find the lattice in an image (row, column), counts.

    `alive` is as `_faint` returns it, None if all lenslets are.
    """
    limits = {name: most * (1.0 if alive is None else _FAINT_FACTOR) for name, most in _LATTICE_LIMITS.items()}
    limits |= {"whole, wrong by": 0.0, "lit, wrong": 0.0}
    if light.size <= _TIMED_PIXELS:
        limits["CPU time (s)"] = _LONGEST_S
    begun_s, problem = time.thread_time(), ""
    try:
        found = survey(light, reference.bench.sensor)
        measured = _errors(found, reference.lattice, reference.bench.sensor, alive)
        measured["CPU time (s)"] = time.thread_time() - begun_s
    except ReconstructionError as error:
        measured = dict.fromkeys([*_LATTICE_LIMITS, "whole, wrong by", "lit, wrong", "CPU time (s)"], math.nan)
        problem = str(error)
    case = f"{reference.case}, {'clean' if alive is None else 'faint'}"
    return trial(case=case, name=reference.name, measured=measured, limits=limits, problem=problem)


def _errors(found: Survey, truth: Lattice, sensor: Sensor, alive: Floats | None) -> dict[str, float]:
    """Return errors of a lattice by name with unit; `alive` as in `_lattice_trial`."""
    lattice = found.lattice
    whole = abs(found.rows - sensor.lenslet_rows) + abs(found.columns - sensor.lenslet_columns)
    is_lit = np.ones_like(found.illuminated) if alive is None else alive > 0
    return {
        "centre (px)": math.hypot(lattice.center_x_px - truth.center_x_px, lattice.center_y_px - truth.center_y_px),
        "pitch (px)": abs(lattice.pitch_px - truth.pitch_px),
        "rotation (mrad)": abs(lattice.rotation_rad - truth.rotation_rad) * 1e3,
        "whole, wrong by": float(whole),
        "lit, wrong": float(np.count_nonzero(found.illuminated != is_lit)),
    }


_STARTS, _RIGHT = 9, 7  # log-spaced first and right exposures
_CURRENTS_A = (0.0, 0.35, 1.0)  # at the start; the highest is 1 A
_USUAL_A = 0.35
_IMAGES: dict[str, Floats] = {
    "squares": squares(),
    "broad": squares(width_px=13.0),
    "haze": squares(background=0.2),
    "spots": spots(),
}
_EXPOSURE_LIMITS = {"frames": MOST_FRAMES, "fill beside 70 % (%)": 100 * TOLERANCE, "light left on": 0.0}


@dataclass(frozen=True, slots=True)
class _Camera:
    name: str
    exposures_s: Range
    detector: dict[str, Any]  # settings of the scene


_SIXTEEN = {"bits": 16, "offset_counts": 500.0, "read_noise_counts": 6.4, "counts_per_electron": 1 / 5.8}
_TWELVE = {"bits": 12, "offset_counts": 100.0, "read_noise_counts": 2.0, "counts_per_electron": 0.2}
_EIGHT = {"bits": 8, "offset_counts": 4.0, "read_noise_counts": 0.8, "counts_per_electron": 0.02}
_CUT_OFF = {**_EIGHT, "offset_counts": 0.0}  # half of the noise lies below 0
_WIDEST = Range(1e-5, 7200.0)
_CAMERAS = (
    _Camera("C9100, EM, speed 3", exposure_range_s("em", 3), _SIXTEEN),
    _Camera("C9100, EM, speed 2", exposure_range_s("em", 2), _SIXTEEN),
    _Camera("C9100, normal", exposure_range_s("normal", 1), _SIXTEEN),
    _Camera("16 bits", _WIDEST, _SIXTEEN),
    _Camera("12 bits", _WIDEST, _TWELVE),
    _Camera("8 bits", _WIDEST, _EIGHT),
    _Camera("8 bits, no offset", _WIDEST, _CUT_OFF),
)


def _expose(_bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    cases = list(itertools.product(_CAMERAS, _CURRENTS_A))
    for done, (tried, current_a) in enumerate(cases):
        case, allowed = f"{tried.name}, {current_a:g} A", tried.exposures_s
        progress(case, done / len(cases))
        rights_s, starts_s = (np.geomspace(allowed.minimum, allowed.maximum, count) for count in (_RIGHT, _STARTS))
        for image, right_s, start_s, seed in itertools.product(_IMAGES, rights_s, starts_s, seeds):
            first_s = allowed.nearest(float(start_s))  # geomspace rounds
            full_scale = 2 ** tried.detector["bits"] - 1
            scene = LampScene(
                counts_per_a_s=(FILL * full_scale - tried.detector["offset_counts"]) / (_USUAL_A * float(right_s)),
                exposure_range_s=allowed,
                image=_IMAGES[image],
                seed=seed,
                **tried.detector,
            )
            devices, instrument, lamp = exposure_bench(scene, exposure_s=first_s, current_a=current_a)
            problem, fill, frames = "", math.nan, math.nan
            try:
                fill = auto_expose(devices, PITCH_PX, UNWATCHED).fill
                frames = len(instrument.exposed_s)
            except RoutineError as error:
                problem = str(error)
            values = (frames, 100 * abs(fill - FILL), float(lamp.is_on))
            name = f"{image}, {right_s:.3g} s wanted, from {first_s:.3g} s, seed {seed}"
            measured = dict(zip(_EXPOSURE_LIMITS, values, strict=True))
            yield trial(case=case, name=name, measured=measured, limits=_EXPOSURE_LIMITS, problem=problem)


EXPOSURE = TrialStudy(name="exposure", title="Auto-exposure from any start", measure=_expose)

"""Lattices found in reference frames.

Lattices are the bench's, random ones, and those of reference frames from a folder; a faint frame has 200 electrons in
its brightest pixel, dead lenslets and uneven light.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.bench.config import Bench, load_bench
from app.bench.imaging_model import by_pixel
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames, simulating
from app.images import read_image
from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Lattice
from reconstruction.lattice.search import Survey, survey
from simulated_devices.settings import Mask
from studies.estimators import camera
from studies.tables import Asked, Made, Row, steps, trial, trials

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
class Reference:
    """A reference frame with its true lattice."""

    case: str
    light: Image  # without noise, (row, column), any unit
    lattice: Lattice
    bench: Bench
    seed: int


def calibration(asked: Asked) -> Made:
    """Errors of lattices found in clean and faint frames: the bench's, random ones, and those of --frames."""
    rows: list[Row] = []
    for seed in steps(asked.seeds, "seeds"):
        for reference in (
            *_from_folder(asked.frames, seed),
            *_unchanged(asked.bench, seed),
            *_random(asked.bench, seed),
        ):
            if seed == 0 or "random" in reference.case:  # without noise the others never change
                rows.append(lattice_trial(reference, reference.light * (_CLEAN_PEAK / reference.light.max()), None))
            rows.append(lattice_trial(reference, *_faint(reference)))
    return trials(rows, "Lattices found: how far from the truth")


def _from_folder(folder: Path | None, seed: int) -> Iterator[Reference]:
    if folder is None:
        return
    paths = sorted(folder.glob("*_reference.tif"))
    if not paths:
        raise InputError(f"{folder}: holds no *_reference.tif")
    bench = load_bench(folder / "bench.toml")
    for path in paths:
        light = np.asarray(read_image(path), np.float32)
        yield Reference(path.name, light, bench.design_lattice(*light.shape), bench, seed)


def _unchanged(bench: Bench, seed: int) -> Iterator[Reference]:
    for mask in _MASKS:
        light = NoiseFreeFrames(bench).reference(mask)
        lattice = bench.design_lattice(*light.shape)
        yield Reference(f"the bench's lattice, {mask}", light, lattice, bench, seed)


def _random(bench: Bench, seed: int) -> Iterator[Reference]:
    """Frames with a random lattice each, whose edge cuts a ring of lenslets."""
    rng = np.random.default_rng(seed)
    sensor, pitch_px = bench.sensor, bench.sensor.lenslet_pitch_px
    rows, columns = (int((count + _ROOM) * pitch_px) for count in sensor.lenslets)
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
        yield Reference(f"random lattices, {mask}", light, lattice, changed, seed)


def _faint(reference: Reference) -> tuple[Image, Floats]:
    """The camera's frame, counts, and 1 for living, 0 for dead lenslets (lenslet_row, lenslet_column)."""
    sensor, ring = reference.bench.sensor, _BORDER + 1
    shape = sensor.lenslets[0] + 2 * ring, sensor.lenslets[1] + 2 * ring
    alive = (np.random.default_rng(reference.seed).random(shape) >= _DEAD_SHARE).astype(np.float64)
    uneven = np.add.outer(*(np.linspace(0.5, _DIMMEST / 2, count) for count in shape))
    light = reference.light * by_pixel(alive * uneven, reference.lattice, *reference.light.shape)
    electrons = light * (_FAINT_PEAK_E / light.max())
    return camera(reference.bench).exposed(electrons, reference.seed, 0), alive[ring:-ring, ring:-ring]


def lattice_trial(reference: Reference, light: Image, alive: Floats | None) -> Row:
    """Find the lattice in an image (row, column), counts.

    `alive` is as `_faint` returns it, None if all lenslets are.
    """
    limits = {name: most * (1.0 if alive is None else _FAINT_FACTOR) for name, most in _LATTICE_LIMITS.items()}
    limits["lit, wrong"] = 0.0
    if light.size <= _TIMED_PIXELS:
        limits["CPU time (s)"] = _LONGEST_S
    begun_s, problem = time.thread_time(), ""
    try:
        found = survey(light, reference.bench.sensor)
        measured = _errors(found, reference.lattice, alive)
        measured["CPU time (s)"] = time.thread_time() - begun_s
    except ReconstructionError as error:
        measured = dict.fromkeys([*_LATTICE_LIMITS, "lit, wrong", "CPU time (s)"], math.nan)
        problem = str(error)
    case = f"{reference.case}, {'clean' if alive is None else 'faint'}"
    return trial(case, measured, limits, problem)


def _errors(found: Survey, truth: Lattice, alive: Floats | None) -> dict[str, float]:
    """Return errors of a lattice by name with unit; `alive` as in `lattice_trial`."""
    lattice = found.lattice
    is_lit = np.ones_like(found.illuminated) if alive is None else alive > 0
    return {
        "centre (px)": math.hypot(lattice.center_x_px - truth.center_x_px, lattice.center_y_px - truth.center_y_px),
        "pitch (px)": abs(lattice.pitch_px - truth.pitch_px),
        "rotation (mrad)": abs(lattice.rotation_rad - truth.rotation_rad) * 1e3,
        "lit, wrong": float(np.count_nonzero(found.illuminated != is_lit)),
    }

"""How well `svwfs calibrate` finds lattices: on the bench as it is, on random lattices, on another simulator's frames.

The truth is what the simulator was told. A faint frame holds so few electrons in its brightest pixel, some of its
lenslets are dead and the others unevenly lit; the camera is the bench's.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.bench.config import Bench, load_bench
from app.evaluation.noise_free import NoiseFreeFrames
from app.evaluation.study.defects import lattice_of
from app.evaluation.study.noise import camera
from app.evaluation.study.trials import Trial, TrialStudy
from app.files import read_image
from app.measurement.imaging_model import by_pixel
from app.progress import Progress
from reconstruction.arrays import Floats, Image
from reconstruction.errors import ReconstructionError
from reconstruction.geometry import Lattice, Sensor
from reconstruction.lattice.search import Survey, survey
from simulated_devices.settings import Mask

_ASKED = {"centre (px)": 0.1, "pitch (px)": 0.02, "rotation (mrad)": 0.2}
_FAINT_TIMES = 2.0  # as much is allowed on a faint frame
_MOST_S, _TIMED_PIXELS = 2.0, 512 * 512
_CLEAN_PEAK, _FAINT_PEAK_E, _DEAD = 1e4, 200.0, 0.1
_UNEVEN = 0.4  # of the light is left in the dimmest corner
_READ_OUT = 1  # the slowest

_MASKS: tuple[Mask, ...] = ("square", "stars")
_BORDER = 1  # rings of lenslets that the frame's edge cuts
_ROOM = 1.4  # pitches for them, both sides together: less than two, or more lenslets would lie whole on the frame
_CENTER_PX, _PITCH, _ROTATION_RAD = 3.0, 0.008, 0.01  # by so much may a random lattice differ from the bench's

_ROOT = Path(__file__).parents[3]
_FOREIGN = (
    _ROOT.parent / "shared" / "frames",
    _ROOT / "tests" / "support" / "foreign_frames",
)  # the first that is there


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A reference and the truth about it."""

    case: str
    name: str
    light: Image  # without noise, (row, column), any unit
    lattice: Lattice
    bench: Bench
    seed: int


def _run(bench: Bench, seeds: int, progress: Progress) -> Iterator[Trial]:
    for done, seed in enumerate(range(seeds)):
        frames = [*_foreign(seed), *_as_it_is(bench, seed), *_random(bench, seed)]
        for index, frame in enumerate(frames):
            progress(f"{frame.case}, {frame.name}", (done + index / len(frames)) / seeds)
            if seed == 0 or "random" in frame.case:  # without noise the others are always the same
                yield _trial(frame, frame.light * (_CLEAN_PEAK / frame.light.max()), None)
            yield _trial(frame, *_faint(frame))


def _as_it_is(bench: Bench, seed: int) -> Iterator[_Frame]:
    for mask in _MASKS:
        light = NoiseFreeFrames(bench).reference(mask)
        yield _Frame(f"the bench's lattice, {mask}", f"seed {seed}", light, lattice_of(bench), bench, seed)


def _random(bench: Bench, seed: int) -> Iterator[_Frame]:
    """Frames whose edge cuts a ring of lenslets all around, each with another lattice."""
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
        changed = replace(
            bench,
            lattice=lattice,
            camera=replace(bench.camera_model, rows=rows, columns=columns),
            simulation=replace(bench.simulation, border_lenslets=_BORDER),
        )
        light = NoiseFreeFrames(changed).reference(mask)
        yield _Frame(f"random lattices, {mask}", f"seed {seed}", light, lattice, changed, seed)


def _foreign(seed: int) -> Iterator[_Frame]:
    """References of another simulator, if there are any beside the project or in its tests."""
    folder = next((folder for folder in _FOREIGN if (folder / "bench.toml").is_file()), None)
    for path in sorted(folder.glob("*_reference.tif")) if folder else ():
        bench = load_bench(str(path.with_name("bench.toml")))
        light = np.asarray(read_image(path), np.float32)
        yield _Frame(f"HCIPy's {path.name}", f"seed {seed}", light, lattice_of(bench), bench, seed)


def _faint(frame: _Frame) -> tuple[Image, Floats]:
    """The camera's frame, counts, and which of the sensor's lenslets are alive, (lenslet_row, lenslet_column)."""
    sensor, ring = frame.bench.sensor, _BORDER + 1
    shape = sensor.lenslet_rows + 2 * ring, sensor.lenslet_columns + 2 * ring
    alive = (np.random.default_rng(frame.seed).random(shape) >= _DEAD).astype(np.float64)
    uneven = np.add.outer(*(np.linspace(0.5, _UNEVEN / 2, count) for count in shape))
    light = frame.light * by_pixel(alive * uneven, frame.lattice, *frame.light.shape)
    counts = camera(frame.bench, _READ_OUT, 1.0).exposed(light * (_FAINT_PEAK_E / light.max()), frame.seed, 0)
    return counts, alive[ring:-ring, ring:-ring]


def _trial(frame: _Frame, light: Image, alive: Floats | None) -> Trial:
    """Calibrate by a frame of which so many lenslets are alive; all without `alive`, and then it is a clean one."""
    asked = {name: most * (1.0 if alive is None else _FAINT_TIMES) for name, most in _ASKED.items()}
    asked |= {"whole, wrong by": 0.0, "lit, wrong": 0.0}
    if light.size <= _TIMED_PIXELS:
        asked["CPU time (s)"] = _MOST_S
    case = f"{frame.case}, {'clean' if alive is None else 'faint'}"
    begun_s = time.thread_time()
    try:
        found = survey(light, frame.bench.sensor)
    except ReconstructionError as error:
        figures = dict.fromkeys([*_ASKED, "whole, wrong by", "lit, wrong", "CPU time (s)"], math.nan)
        return Trial(case=case, name=frame.name, figures=figures, asked=asked, refusal=str(error))
    seconds = time.thread_time() - begun_s
    figures = _errors(found, frame.lattice, frame.bench.sensor, alive) | {"CPU time (s)": seconds}
    return Trial(case=case, name=frame.name, figures=figures, asked=asked)


def _errors(found: Survey, truth: Lattice, sensor: Sensor, alive: Floats | None) -> dict[str, float]:
    """How far what was found is from the truth."""
    lattice = found.lattice
    away_px = math.hypot(lattice.center_x_px - truth.center_x_px, lattice.center_y_px - truth.center_y_px)
    whole = abs(found.rows - sensor.lenslet_rows) + abs(found.columns - sensor.lenslet_columns)
    lit = np.ones_like(found.illuminated) if alive is None else alive > 0
    return {
        "centre (px)": away_px,
        "pitch (px)": abs(lattice.pitch_px - truth.pitch_px),
        "rotation (mrad)": abs(lattice.rotation_rad - truth.rotation_rad) * 1e3,
        "whole, wrong by": float(whole),
        "lit, wrong": float(np.count_nonzero(found.illuminated != lit)),
    }


CALIBRATION = TrialStudy(name="calibration", title="Lattices found: how far from the truth", run=_run)

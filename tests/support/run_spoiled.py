"""Count spoiled frames that give a wrong wavefront without a word, and good ones that raise an alarm.

    PYTHONPATH=tests python -m support.run_spoiled [good frames]

Three benches in real light: the default, the checkerboard, and the affine warp in little light.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from app.bench.config import load_bench
from app.errors import InputError
from app.evaluation.frames import NoiseFreeFrames
from app.measurement.bench_reconstructor import reconstructor as reconstructor_of
from reconstruction.arrays import Floats
from reconstruction.errors import ReconstructionError
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.wavefront import Wavefront, rms
from support.spoiled_frames import Light, Spoiled, kinds

REFERENCE_FRAMES = 10  # averaged for good frames
WRONG_SIGMA, WRONG_SHARE = 3.0, 0.2  # an error above both, the second of the truth, is wrong


@dataclass(frozen=True)
class Case:
    """A bench with its light."""

    mask: str
    peak_e: float
    settings: tuple[str, ...] = ()
    other: str = "circle"


CASES = {
    "default": Case("square", 1e4, ("simulation.source.mask=square",)),
    "checkerboard": Case("checkerboard", 1e4, ("simulation.source.mask=checkerboard",), "square"),
    "affine": Case("square", 1e3, ("simulation.source.mask=square", "registration.warp=affine")),
}


@cache
def rendered(case: Case, seed: int = 1, rms_rad: float = 2.0) -> tuple[Light, Floats]:
    """Light of a bench, electrons, and its true wavefronts, rad."""
    screen = (f"simulation.seed={seed}", f"simulation.screen.rms_rad={rms_rad}")
    frames = NoiseFreeFrames(load_bench("small_demo", (*case.settings, *screen)))
    reference, found = frames.reference(case.mask), frames.frame(case.mask)
    scale = case.peak_e / float(reference.max())
    images = (reference, found.photons, frames.reference(case.other))
    return Light(*(np.asarray(image * scale, np.float64) for image in images)), found.truth


def measured(case: Case, spoiled: Spoiled, light: Light, seed: int, averaged: int = 1) -> tuple[Wavefront, Quality]:
    dark, reference, frame = spoiled.exposed(light, seed, averaged)
    bench = load_bench("small_demo", (*case.settings, *spoiled.settings))
    reconstructor = reconstructor_of(bench, reference, dark=dark, frame=frame)
    wavefront = reconstructor(frame)
    return wavefront, reconstructor.quality(frame, wavefront)


def error(wavefront: Wavefront, truth: Floats) -> tuple[float, float, float]:
    """Error, its standard deviation as claimed, and the truth, each an RMS over lenslets and views, rad."""
    sigma = wavefront.sigma()
    return (
        float(np.sqrt(np.nanmean(rms(wavefront.views - truth) ** 2))),
        float(np.sqrt(np.nanmean(sigma**2))),
        float(np.sqrt(np.nanmean(rms(truth) ** 2))),
    )


def verdicts(case: Case, names: set[str] | None = None) -> Iterator[tuple[str, str, float, str]]:
    """Name, verdict, error over the truth, and the reasons, of every kind."""
    light, truth = rendered(case)
    for name, spoiled in kinds(case.peak_e):
        if names is not None and name not in names:
            continue
        try:
            wavefront, quality = measured(case, spoiled, light, 1)
        except (ReconstructionError, InputError) as refusal:
            yield name, "refused", np.nan, str(refusal)
            continue
        off, sigma, size = error(wavefront, truth)
        is_wrong = off > WRONG_SIGMA * sigma and off > WRONG_SHARE * size
        found = "flagged" if quality.faults else "silent"
        yield name, f"wrong, {found}" if is_wrong else f"right, {found}", off / size, quality.sentence


def alarms(count: int) -> Iterator[tuple[str, Fault, str]]:
    """Good frames that are flagged: of all benches, strengths, light levels and screens."""
    for number in range(count):
        name, case = list(CASES.items())[number % len(CASES)]
        bright = Case(case.mask, (200.0, 1e3, 1e4, 3e4)[number // 3 % 4], case.settings, case.other)
        light, _ = rendered(bright, 1 + number // 60, (0.5, 1.0, 2.0, 3.0)[number // 12 % 4])
        _, quality = measured(bright, Spoiled(), light, number, REFERENCE_FRAMES)
        if quality.faults:
            yield f"{name} {number}", quality.faults, quality.sentence


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Print every kind, and the counts."""
    total: Counter[str] = Counter()
    for bench, case in CASES.items():
        for name, verdict, share, sentence in verdicts(case):
            total[verdict] += 1
            say(f"{bench:13}{name:34}{verdict:16}{share:8.2f}  {sentence[:150]}")
    say(str(dict(total)))
    _say_alarms(int(sys.argv[1]) if len(sys.argv) > 1 else 60)


def _say_alarms(count: int) -> None:
    found = 0
    for name, faults, sentence in alarms(count):
        found += 1
        say(f"false alarm: {name} {faults!r} {sentence}")
    say(f"{found} false alarms in {count} good frames")


if __name__ == "__main__":
    main()

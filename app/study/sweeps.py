"""All sweeps, and running them: what is finished is on disk, whatever happens afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from app.config import Bench
from app.errors import InputError, Interrupted
from app.files import make_folder
from app.progress import Report, named, part
from app.study.defects import DEAD, FOCAL_LENGTH, LATTICE
from app.study.ensembles import ENSEMBLES
from app.study.noise import EM_GAIN, PHOTONS
from app.study.observations import Outcome, Sweep
from app.study.output import write_study
from app.study.screens import EXPERIMENT, ROUGHNESS, SIZE
from app.study.sources import SOURCE

SWEEPS: dict[str, Sweep] = {
    sweep.name: sweep
    for sweep in (ENSEMBLES, ROUGHNESS, SIZE, EXPERIMENT, PHOTONS, EM_GAIN, SOURCE, LATTICE, FOCAL_LENGTH, DEAD)
}


def chosen_sweeps(names: Sequence[str]) -> list[Sweep]:
    """Return the sweeps with those names, each once; all of them without a name."""
    for name in names:
        if name not in SWEEPS:
            raise InputError(f"no sweep is called {name}; there are {', '.join(SWEEPS)}")
    return [SWEEPS[name] for name in dict.fromkeys(names)] or list(SWEEPS.values())


def run_study(bench: Bench, sweeps: Sequence[Sweep], seeds: int, out: Path, report: Report) -> list[Outcome]:
    """Run sweeps; write study.json, study.csv and estimator.png into the folder `out` after each."""
    make_folder(out)
    outcomes: list[Outcome] = []
    try:
        for index, sweep in enumerate(sweeps):
            step = named(part(report, index, len(sweeps)), sweep.name)
            step("beginning", 0.0)
            outcomes.append(Outcome(sweep, tuple(sweep.run(bench, seeds, step))))
            write_study(outcomes, seeds, out)
    except Interrupted:
        finished = f"{len(outcomes)} of {len(sweeps)} sweeps are in {out}" if outcomes else "no sweep was finished"
        raise Interrupted(f"interrupted: {finished}") from None
    return outcomes

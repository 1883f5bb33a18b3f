"""All sweeps and trials, and running them: what is finished is on disk, whatever happens afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from app.bench.config import Bench
from app.errors import InputError, Interrupted
from app.evaluation.study.calibration import CALIBRATION
from app.evaluation.study.defects import DEAD, FOCAL_LENGTH, LATTICE
from app.evaluation.study.ensembles import ENSEMBLES
from app.evaluation.study.exposure import EXPOSURE
from app.evaluation.study.noise import EM_GAIN, PHOTONS
from app.evaluation.study.observations import Outcome, Sweep
from app.evaluation.study.output import print_study, write_study
from app.evaluation.study.screens import EXPERIMENT, ROUGHNESS, SIZE
from app.evaluation.study.sources import SOURCE
from app.evaluation.study.trial_output import print_trials, write_trials
from app.evaluation.study.trials import TrialOutcome, TrialStudy
from app.files import make_folder
from app.progress import Progress, named, part

SWEEPS: dict[str, Sweep] = {
    sweep.name: sweep
    for sweep in (ENSEMBLES, ROUGHNESS, SIZE, EXPERIMENT, PHOTONS, EM_GAIN, SOURCE, LATTICE, FOCAL_LENGTH, DEAD)
}
TRIALS: dict[str, TrialStudy] = {study.name: study for study in (CALIBRATION, EXPOSURE)}


def chosen_sweeps(names: Sequence[str]) -> list[Sweep | TrialStudy]:
    """Return the sweeps and trials with those names, each once; all sweeps without a name."""
    known: dict[str, Sweep | TrialStudy] = {**SWEEPS, **TRIALS}
    for name in names:
        if name not in known:
            raise InputError(f"no sweep is called {name}; there are {', '.join(known)}")
    return [known[name] for name in dict.fromkeys(names)] or [*SWEEPS.values()]


def run_study(
    bench: Bench, studies: Sequence[Sweep | TrialStudy], seeds: int, out: Path, progress: Progress
) -> list[Outcome | TrialOutcome]:
    """Run sweeps and trials; write what they show into the folder `out` after each.

    All sweeps together are study.json, study.csv and estimator.png; trials have files of their own name.
    """
    make_folder(out)
    outcomes: list[Outcome | TrialOutcome] = []
    try:
        for index, study in enumerate(studies):
            step = named(part(progress, index, len(studies)), study.name)
            step("beginning", 0.0)
            if isinstance(study, TrialStudy):
                tried = TrialOutcome(study, tuple(study.run(bench, seeds, step)))
                write_trials(tried, seeds, out)
                outcomes.append(tried)
            else:
                outcomes.append(Outcome(study, tuple(study.run(bench, seeds, step))))
                write_study(_sweeps(outcomes), seeds, out)
    except Interrupted:
        finished = f"{len(outcomes)} of {len(studies)} sweeps are in {out}" if outcomes else "no sweep was finished"
        raise Interrupted(f"interrupted: {finished}") from None
    return outcomes


def print_outcomes(outcomes: Sequence[Outcome | TrialOutcome]) -> None:
    """Print the tables of sweeps and trials."""
    if sweeps := _sweeps(outcomes):
        print_study(sweeps)
    for outcome in outcomes:
        if isinstance(outcome, TrialOutcome):
            print_trials(outcome)


def _sweeps(outcomes: Sequence[Outcome | TrialOutcome]) -> list[Outcome]:
    return [outcome for outcome in outcomes if isinstance(outcome, Outcome)]

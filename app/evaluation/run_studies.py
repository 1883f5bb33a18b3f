"""Running studies; the results of every finished study are on disk, even after Ctrl-C."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from app.bench.config import Bench
from app.errors import InputError, Interrupted
from app.evaluation.cases import CaseResult, collect
from app.evaluation.study_files import write_newest
from app.evaluation.study_kinds import Study, StudyResult
from app.files import make_folder
from app.progress import Progress, named, part
from app.tasks import Evaluate

_Measured = Iterator[tuple[Study, Sequence[CaseResult]]]


@dataclass(frozen=True, slots=True)
class _Part:
    """One seed of a study, which a worker measures."""

    study: Study
    bench: Bench
    seed: int


def run_studies(
    bench: Bench, studies: Sequence[Study], seeds: int, out: Path, progress: Progress, evaluate: Evaluate | None = None
) -> list[StudyResult]:
    """Run studies and write the results into the folder `out` after each; see `write_newest` for the files.

    With `evaluate`, each seed of each study is a task; the results do not depend on that.

    Raises
    ------
    InputError
        If the lattice is hexagonal.
    Interrupted
        On Ctrl-C; its text says how many studies are finished.
    """
    if bench.sensor.arrangement != "square":
        raise InputError("studies and tables are made for square lattices: leave out lattice.arrangement")
    make_folder(out)
    results: list[StudyResult] = []
    try:
        measured = _in_turn(bench, studies, seeds, progress)
        if evaluate is not None:
            measured = _shared(bench, studies, seeds, progress, evaluate)
        for study, cases in measured:
            results.append(StudyResult(study, collect(study.dims, cases), seeds))
            write_newest(results, out)
    except Interrupted:
        finished = f"{len(results)} of {len(studies)} studies are in {out}" if results else "no study was finished"
        raise Interrupted(f"interrupted: {finished}") from None
    return results


def _in_turn(bench: Bench, studies: Sequence[Study], seeds: int, progress: Progress) -> _Measured:
    """Measure one study after the other in this process."""
    for index, study in enumerate(studies):
        step = named(part(progress, index, len(studies)), study.name)
        step("beginning", 0.0)
        yield study, list(study.measure(bench, range(seeds), step))


def _shared(bench: Bench, studies: Sequence[Study], seeds: int, progress: Progress, evaluate: Evaluate) -> _Measured:
    """Measure all seeds of all studies on workers; yield the studies in their order."""
    total = seeds * len(studies)
    found: dict[tuple[str, int], Sequence[CaseResult]] = {}
    remaining = list(studies)
    progress(f"0 of {total} parts", 0.0)
    parts = (_Part(study, bench, seed) for study in studies for seed in range(seeds))
    for done, (each, cases) in enumerate(evaluate(_measure, parts), 1):
        if isinstance(cases, Exception):
            raise cases
        found[each.study.name, each.seed] = cases
        progress(f"{done} of {total} parts", done / total)
        while remaining and all((remaining[0].name, seed) in found for seed in range(seeds)):
            study = remaining.pop(0)
            yield study, [case for seed in range(seeds) for case in found.pop((study.name, seed))]


def _measure(each: _Part) -> list[CaseResult]:
    return list(each.study.measure(each.bench, range(each.seed, each.seed + 1), lambda *_: None))

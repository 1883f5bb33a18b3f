"""Running studies one after the other; the results of every finished study are on disk, even after Ctrl-C."""

from collections.abc import Sequence
from pathlib import Path

from app.bench.config import Bench
from app.errors import Interrupted
from app.evaluation.cases import collect
from app.evaluation.study_files import write_newest
from app.evaluation.study_kinds import Study, StudyResult
from app.files import make_folder
from app.progress import Progress, named, part


def run_studies(bench: Bench, studies: Sequence[Study], seeds: int, out: Path, progress: Progress) -> list[StudyResult]:
    """Run studies and write the results into the folder `out` after each; see `write_newest` for the files.

    Raises
    ------
    Interrupted
        On Ctrl-C; its text says how many studies are finished.
    """
    make_folder(out)
    results: list[StudyResult] = []
    try:
        for index, study in enumerate(studies):
            step = named(part(progress, index, len(studies)), study.name)
            step("beginning", 0.0)
            results.append(StudyResult(study, collect(study.dims, study.measure(bench, seeds, step)), seeds))
            write_newest(results, out)
    except Interrupted:
        finished = f"{len(results)} of {len(studies)} studies are in {out}" if results else "no study was finished"
        raise Interrupted(f"interrupted: {finished}") from None
    return results

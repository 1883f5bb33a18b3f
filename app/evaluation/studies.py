"""Studies and their results.

They are measured in turn or shared among workers, and written as each ends, even after Ctrl-C.
A study has a summary over the repeats, files, a figure, and a table on the terminal.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from app.bench.config import Bench
from app.errors import InputError, Interrupted
from app.files import atomic_write, make_folder, write_whole
from app.progress import Evaluate, Progress, named, part
from app.run_facts import write_record
from reconstruction.arrays import Floats

Position = float | str  # a number on an axis, or a name
Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseResult:
    """Everything measured of one case; cases at one position are repeats: seeds, draws of noise."""

    at: Mapping[str, Position]  # position along each dimension of the study
    values: Mapping[str, float | Floats]  # by quantity; NaN or absent without a result
    name: str = ""  # distinguishes repeats
    problem: str = ""  # the reason for a missing result


def collect(dims: Sequence[str], results: Iterable[CaseResult]) -> pd.DataFrame:
    """Return a row for each case: position, name, problem, values; sorted by first occurrence."""
    data = pd.DataFrame(
        {**each.at, "name": each.name, "problem": each.problem, **each.values}  # noqa: PD011 - no data frame
        for each in results
    )
    for dim in dims:
        data[dim] = pd.Categorical(data[dim], categories=data[dim].unique())
    return data.sort_values([*dims], kind="stable", ignore_index=True)


def known_rows(table: pd.DataFrame) -> list[Row]:
    """Return the rows without their unknown numbers."""
    return [
        {name: each for name, each in row.items() if not isinstance(each, float) or math.isfinite(each)}
        for row in table.to_dict("records")
    ]


@dataclass(frozen=True, slots=True)
class Output:
    """The files of a study, or of all sweeps so far."""

    tree: Row  # for JSON
    table: pd.DataFrame  # for CSV
    figure: Figure


class Printed(NamedTuple):
    """The table of a study on the terminal."""

    title: str
    headings: Sequence[str]
    lines: Iterable[Sequence[str]]
    notes: Sequence[str] = ()  # below it


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """A named set of cases; `measure` yields their results, in the same order for each seed."""

    name: str
    title: str
    measure: Callable[[Bench, range, Progress], Iterable[CaseResult]]

    dims: ClassVar[tuple[str, ...]] = ()
    key: ClassVar[str] = ""  # of the lines in the JSON

    @property
    def files(self) -> tuple[str, str, str]:
        """Names of JSON, CSV and PNG."""
        return f"{self.name}.json", f"{self.name}.csv", f"{self.name}.png"

    def summary(self, data: pd.DataFrame) -> pd.DataFrame:
        """Return the numbers over the repeats."""
        raise NotImplementedError

    def output(self, results: "Sequence[StudyResult]") -> Output:
        """Return what is written of the newest of some results, which is of this study; here its summary."""
        data = results[-1].data
        table = self.summary(data)
        tree = {"seeds": results[-1].seeds, "title": self.title, self.key: known_rows(table)}
        return Output(tree, table, self.figure(data))

    def printed(self, data: pd.DataFrame) -> Printed:
        """Return what is printed."""
        raise NotImplementedError

    def figure(self, data: pd.DataFrame) -> Figure:
        """Return the figure."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class StudyResult:
    """A finished study."""

    study: Study
    data: pd.DataFrame
    seeds: int


_Measured = Iterator[tuple[Study, Sequence[CaseResult]]]


def run_studies(
    studies: Sequence[Study],
    bench: Bench,
    *,
    seeds: int,
    out: Path,
    progress: Progress,
    evaluate: Evaluate | None = None,
) -> list[StudyResult]:
    """Run studies and write the results into the folder `out` after each; see `Study.files`.

    With `evaluate`, each seed of each study is a task; the results do not depend on that. `InputError` if the lattice
    is hexagonal, `Interrupted` on Ctrl-C, with how many studies are finished.
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


def _one_seed(bench: Bench, of: tuple[Study, int]) -> list[CaseResult]:
    """Measure one seed of a study, on a worker."""
    study, seed = of
    return list(study.measure(bench, range(seed, seed + 1), lambda *_: None))


def _shared(bench: Bench, studies: Sequence[Study], seeds: int, progress: Progress, evaluate: Evaluate) -> _Measured:
    """Measure all seeds of all studies on workers; yield the studies in their order."""
    total = seeds * len(studies)
    found: dict[tuple[str, int], Sequence[CaseResult]] = {}
    remaining = list(studies)
    progress(f"0 of {total} parts", 0.0)
    parts = ((study, seed) for study in studies for seed in range(seeds))
    for done, ((of_study, of_seed), cases) in enumerate(evaluate(partial(_one_seed, bench), parts), 1):
        if isinstance(cases, Exception):
            raise cases
        found[of_study.name, of_seed] = cases
        progress(f"{done} of {total} parts", done / total)
        while remaining and all((remaining[0].name, seed) in found for seed in range(seeds)):
            study = remaining.pop(0)
            yield study, [case for seed in range(seeds) for case in found.pop((study.name, seed))]


def files_of(studies: Iterable[Study], out: Path) -> list[Path]:
    """Return the files that `write_newest` writes."""
    return [out / name for name in dict.fromkeys(name for study in studies for name in study.files)]


def write_newest(results: Sequence[StudyResult], out: Path) -> None:
    """Write the files of the newest result into the folder `out`, those of sweeps for all sweeps so far."""
    study = results[-1].study
    made = study.output(results)
    numbers, table, picture = (out / name for name in study.files)
    write_record(numbers, made.tree)
    write_whole(table, made.table.to_csv(index=False, lineterminator="\r\n"))
    with atomic_write(picture) as temporary:
        made.figure.savefig(temporary, dpi=100)

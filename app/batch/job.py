"""Settings of a batch, which all results in one store share, and its recordings, identified by `run.json` alone."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

from app.bench.config import parse_bench
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.recording.folder import RUN, read_run, recorded_frames
from app.recording.reader import selected
from app.recording.reprocess import Change
from app.results.replay import change_of


def _software() -> str:
    return f"svwfs {version('svwfs')}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """How each recording is reconstructed. Another version of the software may compute other bits."""

    bench: str = ""  # TOML text of another bench; empty: each recording's own
    settings: tuple[str, ...] = ()  # changes of the recorded benches
    rounds: int = 0  # of refinement, at most
    frames: str = ""  # of each recording, FIRST:END; empty: all
    software: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "software", self.software or _software())

    @property
    def is_of_this_software(self) -> bool:
        """True if this process runs the same version of svwfs."""
        return self.software == _software()

    @property
    def change(self) -> Change:
        """The change of a recorded calibration; it registers in one thread, as each worker has one core."""
        other = change_of(parse_bench(self.bench, "the bench") if self.bench else None, self.settings)

        def change(calibration: Calibration) -> Calibration:
            changed = calibration if other is None else other(calibration)
            registration = replace(changed.bench.registration, threads=1)
            return replace(changed, bench=replace(changed.bench, registration=registration))

        return change


@dataclass(frozen=True, slots=True)
class Source:
    """A complete recording."""

    folder: Path  # absolute
    fingerprint: str  # of run.json, which holds the time, the counts and the bench: the same for a copy
    frames: int
    chosen: range  # of the frames


def find_sources(folders: Iterable[Path], frames: str = "") -> tuple[list[Source], dict[Path, str], dict[Path, Path]]:
    """Check recordings; return the complete ones, each once, the reason for each other folder, and copies of which.

    `frames` as FIRST:END chooses some of each; empty: all.
    """
    found: dict[str, Source] = {}
    problems: dict[Path, str] = {}
    copies: dict[Path, Path] = {}
    for folder in folders:
        try:
            source = _source(folder, frames)
            first = found.setdefault(source.fingerprint, source)
            if first.folder != source.folder:
                copies[folder] = first.folder
        except InputError as error:
            problems[folder] = str(error)
    return list(found.values()), problems, copies


def _source(folder: Path, chosen: str) -> Source:
    run = read_run(folder)
    if not run["complete"]:
        raise InputError(f"{folder}: is not complete: it still grows, or svwfs recover finishes it")
    frames = recorded_frames(run)
    if frames is None:
        raise InputError(f"{folder / RUN}: does not tell the number of frames; svwfs recover counts them")
    if not frames:
        raise InputError(f"{folder}: holds no frame")
    fingerprint = hashlib.sha256((folder / RUN).read_bytes()).hexdigest()[:16]
    return Source(folder.absolute(), fingerprint, frames, selected(chosen or None, frames, folder))


def unique_names(folders: Iterable[Path], taken: Iterable[str]) -> list[str]:
    """Name each folder by the fewest last parts of its path that no other name has; numbered where paths are equal."""
    known = set(taken)
    names: list[str] = []
    for folder in folders:
        parts = folder.parts[1:]
        candidates = ["/".join(parts[-count:]) for count in range(1, len(parts) + 1)]
        free = (name for name in candidates if name not in known)
        name = next(free, None) or next(
            f"{candidates[0]}-{number}"
            for number in range(2, len(known) + 3)
            if f"{candidates[0]}-{number}" not in known
        )
        known.add(name)
        names.append(name)
    return names

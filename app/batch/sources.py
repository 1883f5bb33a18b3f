"""Recordings of a batch: found, checked and identified by `run.json` alone."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from app.errors import InputError
from app.recording.folder import RUN, read_run, recorded_frames
from app.recording.reader import selected


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

"""The folder of a recording: names in it, `run.json`, free folders and the lock."""

import json
import os
import re
from contextlib import suppress
from glob import escape
from itertools import chain, count
from pathlib import Path
from typing import IO, Any

from app.bench.bench_files import WRITTEN_BY_NEWER
from app.bench.config import parse_bench
from app.errors import InputError, RunError
from app.files import (
    RECORDING_PARTS,
    check_readable,
    check_writable,
    file_name_problem,
    has_locked,
    in_words,
    reachable,
)
from app.run_facts import write_record
from reconstruction.runtime.renaming import rename

FORMAT = "svwfs recording 1"

_LATER_FORMAT = re.compile(r"svwfs recording (?!1\b)\d+")
RUN, FRAME_LINES, STORE, _BIASES, CALIBRATIONS = RECORDING_PARTS
BIAS = f"{_BIASES}/{{}}.npy"  # by number (lenslet_row, lenslet_column, field_mode, xy), px
CALIBRATION = f"{CALIBRATIONS}/{{}}"  # folder of a calibration, by number
RESULTS = "results/{}"  # group in the store, by number of the calibration
PIXELS = "0"  # the array of frames in the store: the finest scale of an OME-NGFF image


def read_run(folder: Path) -> dict[str, Any]:
    """Read `run.json`; `InputError` if the folder holds no recording."""
    path = folder / RUN
    try:
        if not folder.is_dir():
            is_file = f"{folder}: not a folder, as a recording is"
            raise InputError(is_file if folder.exists() else f"{folder}: no such folder")
        if not path.exists():
            raise InputError(f"{folder}: holds no recording: there is no {RUN} in it")
    except OSError as error:
        raise _unusable(folder, error) from error
    check_readable(path)
    try:
        run = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: is damaged: {in_words(error)}") from error
    if not isinstance(run, dict) or run.get("format") != FORMAT or "complete" not in run or "bench" not in run:
        newer = isinstance(run, dict) and _LATER_FORMAT.fullmatch(str(run.get("format")))
        why = WRITTEN_BY_NEWER.format(version_of(run) or "of unknown version") if newer else ""
        raise InputError(f"{path}: {why or f'not the file of a recording ({FORMAT})'}")
    return run


def version_of(run: dict[str, Any]) -> str:
    """Return the version of svwfs that wrote `run.json`; empty if it does not tell."""
    versions = run.get("versions")
    return str(versions.get("svwfs", "")) if isinstance(versions, dict) else ""


def recorded_frames(run: dict[str, Any]) -> int | None:
    """Return the number of frames according to `run.json`; None if it does not tell."""
    counts = run.get("frames")
    recorded = counts.get("recorded") if isinstance(counts, dict) else None
    return recorded if isinstance(recorded, int) and recorded >= 0 else None


def parts_of(folder: Path) -> list[Path]:
    """Return the parts of a recording and the files that its bench names, which no command may replace."""
    parts = [folder / part for part in RECORDING_PARTS]
    with suppress(InputError):  # the reader says what is wrong
        parts += parse_bench(str(read_run(folder)["bench"]), RUN).files
    return parts


def check_free(folder: Path) -> None:
    """Raise `InputError` if no recording can begin in the folder."""
    try:
        for name in (RUN, STORE, FRAME_LINES):
            # an empty list of frames was left by a program that died before its first one
            if (folder / name).exists() and (name != FRAME_LINES or (folder / name).stat().st_size):
                raise InputError(f"{folder}: holds a recording already: {name}; choose another folder")
        for parent in Path(os.path.realpath(folder)).parents:
            if all((parent / name).exists() for name in (RUN, FRAME_LINES)):
                raise InputError(f"{folder}: lies in the recording {parent}: choose another folder")
        check_writable(folder)
    except (OSError, ValueError) as error:  # of a NUL in the name
        raise _unusable(folder, error) from error


def remove_empty(folder: Path) -> None:
    """Remove the files of a recording without frames, so that another may begin in its folder."""
    for name in (RUN, FRAME_LINES):
        (folder / name).unlink(missing_ok=True)
    with suppress(OSError):  # it holds other files, or never was
        folder.rmdir()


def new_folder(wanted: Path) -> Path:
    """Make a new folder, named with -2, -3, ... if the name is taken.

    It is taken, too, by a recording of the same second that got a longer name meanwhile.
    """
    try:
        check_writable(wanted.parent)
        reachable(wanted.parent).mkdir(parents=True, exist_ok=True)
        numbered = (wanted.with_name(f"{wanted.name}-{number}") for number in count(2))
        renamed = any(wanted.parent.glob(f"{escape(wanted.name)}-*"))
        return next(folder for folder in chain([] if renamed else [wanted], numbered) if _is_made(folder))
    except (OSError, ValueError) as error:
        raise _unusable(wanted, error) from error


def _is_made(folder: Path) -> bool:
    try:
        reachable(folder).mkdir()
    except FileExistsError:
        return False
    return True


def damaged_name(path: Path) -> Path:
    """Return a free name next to a damaged file, under which it is retained."""
    names = chain(["damaged"], (f"damaged-{number}" for number in count(2)))
    return next(each for name in names if not (each := path.with_suffix(f".{name}{path.suffix}")).exists())


def _unusable(folder: Path, error: OSError | ValueError) -> InputError:
    return InputError(f"{folder}: cannot be used: {getattr(error, 'strerror', None) or error}")


def lock(file: IO[bytes]) -> None:
    """Lock an open file until it closes; `InputError` if it is locked, `RunError` without locks, as on some shares."""
    try:
        if has_locked(file.fileno()):
            return
    except OSError as error:
        remedy = "use a folder on this computer's own disk, or mount the share with file locks"
        raise RunError(f"{file.name}: cannot be locked: {in_words(error)}: {remedy}") from error
    raise InputError(f"{file.name}: is still being recorded, or recovered by another program")


_STAMP = re.compile(r"\d{8}-\d{6}(-kept)?(-\d+)?(?=-|$)")  # of the folders that the window makes
_LONGEST = 100  # letters of a name


def describe(folder: Path, *, name: str, note: str) -> Path:
    """Write a note into `run.json` and append a name to that of the folder; return the folder.

    An empty name removes the one given before; the time in the folder's name stays. The note is written first, so that
    an impossible name does not lose it. `InputError` if the recording is not finished, the name is impossible or taken,
    or the disk refuses.
    """
    run = read_run(reachable(folder))
    if not run["complete"]:
        raise InputError(f"{folder}: is still being recorded: it gets its name afterwards")
    wanted = folder
    try:
        if run.get("note", "") != note.strip():
            write_record(folder / RUN, {**run, "note": note.strip()})
        name, stamp = name.strip(), _STAMP.match(folder.name)
        if problem := name_problem(name):
            raise InputError(f"{problem}: {name}")
        kept = stamp[0] if stamp else ""
        wanted = folder.with_name("-".join(filter(None, (kept, name))) or folder.name)
        if wanted != folder and wanted.exists():
            raise InputError(f"{wanted}: exists already: give another name")
        if wanted != folder:
            rename(reachable(folder), reachable(wanted))
    except OSError as error:
        raise InputError(f"{wanted}: cannot be given: {in_words(error)}") from error
    return wanted


def name_problem(name: str) -> str:
    """Return why a name cannot be given to a recording; empty if it can."""
    if problem := file_name_problem(name):
        return f"a name of a recording {problem}"
    if name.startswith("."):
        return "a name of a recording cannot begin with a point"
    return f"a name of a recording has at most {_LONGEST} letters" if len(name) > _LONGEST else ""

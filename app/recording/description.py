"""Name and note that a person gives to a finished recording."""

import re
from pathlib import Path

from app.errors import InputError
from app.files import in_words
from app.recording.folder import RUN, read_run
from app.run_facts import write_record

_STAMP = re.compile(r"\d{8}-\d{6}(-kept)?(-\d+)?(?=-|$)")  # of the folders that the window makes
_FORBIDDEN = re.compile(r'[\\/:*?"<>|\x00-\x1f]')  # in a file name, on any system
_LONGEST = 100


def describe(folder: Path, *, name: str, note: str) -> Path:
    """Write a note into `run.json` and append a name to that of the folder; return the folder.

    An empty name removes the one given before; the time in the folder's name stays. The note is written first, so that
    an impossible name does not lose it.

    Raises
    ------
    InputError
        The recording is not finished, the name is impossible or taken, or the disk refuses.
    """
    run = read_run(folder)
    if not run["complete"]:
        raise InputError(f"{folder}: is still being recorded: it gets its name afterwards")
    wanted = folder
    try:
        if run.get("note", "") != note.strip():
            write_record(folder / RUN, {**run, "note": note.strip()})
        wanted = folder.with_name(_folder_name(folder.name, name.strip()))
        if wanted != folder and wanted.exists():
            raise InputError(f"{wanted}: exists already: give another name")
        return folder if wanted == folder else folder.rename(wanted)
    except OSError as error:
        raise InputError(f"{wanted}: cannot be given: {in_words(error)}") from error


def name_problem(name: str) -> str:
    """Return why a name cannot be given to a recording; empty if it can."""
    if found := _FORBIDDEN.search(name):
        return f"a name of a recording cannot contain {found[0] if found[0].isprintable() else 'control characters'}"
    if name.startswith("."):
        return "a name of a recording cannot begin with a point"
    return f"a name of a recording has at most {_LONGEST} letters" if len(name) > _LONGEST else ""


def _folder_name(present: str, name: str) -> str:
    if problem := name_problem(name):
        raise InputError(f"{problem}: {name}")
    stamp = _STAMP.match(present)
    if stamp is None:
        return name or present
    return f"{stamp[0]}-{name}" if name else stamp[0]

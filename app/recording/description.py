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

    An empty name removes the one given before; the time in the folder's name stays.

    Raises
    ------
    InputError
        The recording is not finished, the name is impossible or taken, or the disk refuses.
    """
    run = read_run(folder)
    if not run["complete"]:
        raise InputError(f"{folder}: is still being recorded: it gets its name afterwards")
    wanted = folder.with_name(_folder_name(folder.name, name.strip()))
    if wanted != folder and wanted.exists():
        raise InputError(f"{wanted}: exists already: give another name")
    try:
        if run.get("note", "") != note.strip():
            write_record(folder / RUN, {**run, "note": note.strip()})
        return folder if wanted == folder else folder.rename(wanted)
    except OSError as error:
        raise InputError(f"{wanted}: cannot be given: {in_words(error)}") from error


def _folder_name(present: str, name: str) -> str:
    if _FORBIDDEN.search(name) or name.startswith(".") or len(name) > _LONGEST:
        raise InputError(
            f'the name "{name}" cannot be used: leave out \\ / : * ? " < > | and use at most {_LONGEST} letters'
        )
    stamp = _STAMP.match(present)
    if stamp is None:
        return name or present
    return f"{stamp[0]}-{name}" if name else stamp[0]

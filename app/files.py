"""The one way to write any file: checked, atomic and durable."""

import csv
import errno
import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from app.errors import InputError, RunError
from reconstruction.runtime.renaming import rename

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_NEW = os.O_WRONLY | os.O_CREAT | os.O_EXCL  # the last refuses a symbolic link
_PARTIAL = ".partial"  # in the name of a file that is being written
_REFUSALS = {
    errno.EROFS: "the disk is read-only",
    errno.EACCES: "no permission to write there",
    errno.EPERM: "no permission to write there",
}
_MORE = 1 << 16  # bytes, for which a disk that was full has no space
MEASURED = ("results.nc", "dark.tif", "reference.tif")  # what `svwfs measure` writes next to the parts of its recording
RECORDING_PARTS = ("run.json", "frames.jsonl", "frames.zarr", "biases", "calibrations")
_FORBIDDEN = re.compile(r'[\\/:*?"<>|\x00-\x1f]')  # in a file name, on any system
_DEVICE = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[1-9\xb9\xb2\xb3]) *(\..*)?", re.IGNORECASE)
_LOCKED_BYTE = 2**31 - 1  # msvcrt counts with 32 bits
_LONG = 150  # letters of a path: Windows allows 259, of which names in a recording take up to 100


def check_readable(path: Path) -> None:
    """Raise `InputError` if a path is no file: a folder, a pipe, or nothing at all."""
    try:
        if not path.is_file():
            leads_nowhere = "is a symbolic link that leads to no file" if path.is_symlink() else "no such file"
            raise InputError(f"{path}: {'not a file' if path.exists() else leads_nowhere}")
    except OSError as error:
        raise InputError(f"{path}: cannot be used: {in_words(error)}") from error


def in_words(error: BaseException) -> str:
    """Say in one line why something failed."""
    text = (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
    return " ".join(text.split()) or type(error).__name__


def make_folder(path: Path) -> None:
    """Make a folder and its parents unless they exist."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{path}: the folder cannot be made: {in_words(error)}") from error


def nearest_existing(path: Path) -> Path:
    """Return the path if it exists, else its nearest existing parent; `OSError` if access is denied."""
    return next(each for each in (path.absolute(), *path.absolute().parents) if each.exists())


def check_writable(folder: Path) -> None:
    """Raise `InputError` if nothing can be written into a folder, which need not exist yet."""
    existing = nearest_existing(folder)
    if not existing.is_dir():
        raise InputError(f"{existing}: not a folder")
    _check_names(folder)
    trial = existing / f".{secrets.token_hex(8)}{_PARTIAL}"  # access lists and file servers tell in no other way
    try:
        os.close(os.open(trial, _NEW))
        trial.unlink()
    except OSError as error:
        raise InputError(f"{existing}: {_REFUSALS.get(error.errno or 0) or in_words(error)}") from error


def _check_names(path: Path) -> None:
    """Raise `InputError` if Windows forbids a part of a path as a name; it might write to another file."""
    for name in path.parts[bool(path.anchor) :] if sys.platform == "win32" else ():
        if name != ".." and (problem := file_name_problem(name)):
            raise InputError(f"{path}: the name {name} {problem}")


def file_name_problem(name: str) -> str:
    """Return why Windows allows no file or folder of this name; empty if it does."""
    if found := _FORBIDDEN.search(name):
        return f"cannot contain {found[0] if found[0].isprintable() else 'control characters'}"
    if name.endswith((".", " ")):
        return "cannot end with a dot or a space"
    if len(name) > 255:
        return "has more than 255 characters"
    return "is reserved by Windows for a device" if _DEVICE.fullmatch(name) else ""


def reachable(path: Path) -> Path:
    r"""Return a path, on Windows a long one with \\?\: without it 260 letters and more are not found."""
    full = os.path.abspath(path)  # noqa: PTH100 - Path.absolute keeps "..", which is not allowed behind \\?\
    if sys.platform != "win32" or len(full) < _LONG or full.startswith("\\\\?\\"):
        return path
    return Path("\\\\?\\UNC" + full[1:] if full.startswith("\\\\") else "\\\\?\\" + full)


def has_locked(descriptor: int) -> bool:
    """Lock an open file until it is closed or the process ends; False if another program has locked it."""
    try:
        if sys.platform != "win32":
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:  # nobody else can read a locked byte: one far behind the end
            place = os.lseek(descriptor, 0, os.SEEK_CUR)
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            os.lseek(descriptor, place, os.SEEK_SET)
    except OSError as error:
        if sys.platform != "win32" and not isinstance(error, BlockingIOError):  # as a disk without locks
            raise
        return False
    return True


def check_outputs(outputs: Iterable[Path | None], *, inputs: Iterable[Path | None] = (), overwrite: bool) -> None:
    """Check the files that a command will write.

    None among `outputs` is an option that was not given. `inputs` are files and folders that the command reads.
    With `overwrite`, existing files may be replaced; inputs never are. `InputError` if an output is an input, lies in
    an input folder or is named twice, is part of a recording, or exists and must not be replaced.
    """
    taken = [path for path in inputs if path is not None]
    for path in outputs:
        if path is None:
            continue
        _check_names(path)
        try:
            if any(_is_part(path, other) for other in taken):
                raise InputError(f"{path}: is used by this command already; give the output another name")
            if _is_recorded(path):
                raise InputError(f"{path}: is part of a recording; give the output another name")
            if path.name in MEASURED and path.exists() and path.with_name("frames.jsonl").is_file():
                raise InputError(f"{path}: was written when this was measured; give the output another name")
            if os.path.lexists(path) and not overwrite:
                raise InputError(f"{path}: exists already; --overwrite replaces it")
            if not path.name or (path.exists() and not path.is_file()):
                raise InputError(f"{path}: not a file that can be written")
            check_writable(path.parent)
        except OSError as error:
            raise InputError(f"{path}: cannot be used: {in_words(error)}") from error
        taken.append(path)


def write_whole(path: Path, contents: str | bytes) -> None:
    """Write a file in one piece (atomic); text as UTF-8."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(contents.encode() if isinstance(contents, str) else contents)


def _is_part(path: Path, other: Path) -> bool:
    if Path(os.path.realpath(path)).is_relative_to(os.path.realpath(other)):
        return True
    return path.exists() and other.exists() and path.samefile(other)  # a hard link


def _is_recorded(path: Path) -> bool:
    """True if a path is, or would be, part of a recording; other files may lie next to its parts."""
    real = Path(os.path.realpath(path))
    return any(one.name in RECORDING_PARTS and one.with_name("frames.jsonl").is_file() for one in (real, *real.parents))


def check_suffix(path: Path | None, *suffixes: str) -> None:
    """Raise `InputError` if a name has another suffix than those of the format that will be written."""
    if path is not None and path.suffix.lower() not in {"", *suffixes}:
        raise InputError(f"{path}: {path.suffix} does not fit the format: end the name with {suffixes[0]}")


def require_suffix(path: Path, *suffixes: str, kind: str = "name") -> None:
    """Raise `InputError` if a name ends in none of these."""
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: give a {kind} that ends in one of {', '.join(suffixes)}")


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield an empty file that replaces `path` on success and is deleted on failure (atomic write).

    Its name cannot be predicted, so that nobody else can put a link there. It is on the disk before it replaces `path`.
    """
    if not path.name or (path.exists() and not path.is_file()):
        raise RunError(f"{path}: not a file that can be written")
    target = reachable(path)
    temporary = target.with_name(f".{secrets.token_hex(8)}{_PARTIAL}{path.suffix}")
    try:
        make_folder(target.parent)
        os.close(os.open(temporary, _NEW, 0o666))
        try:
            yield temporary
            sync(temporary)
            rename(temporary, target)
        except OSError as error:
            if error.errno is None:  # NumPy's "9 requested and 5 written": another write fails with a reason
                with temporary.open("ab") as file:
                    file.write(bytes(_MORE))
            raise
        finally:
            temporary.unlink(missing_ok=True)
        sync(target.parent)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {in_words(error)}") from error


def write_csv(path: Path, names: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write rows as CSV under the names of their columns, numbers with all digits (atomic)."""
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows(rows)


def remove_partial(folder: Path) -> list[Path]:
    """Remove what killed processes left half-written in a folder where nobody writes; return the paths."""
    found = sorted(folder.rglob(f".*{_PARTIAL}*"))
    for left in found:
        try:
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left)
            else:
                left.unlink(missing_ok=True)
        except OSError as error:
            raise RunError(f"{left}: cannot be removed: {in_words(error)}") from error
    return found


def sync(path: Path) -> None:
    """Force a file, or the names in a folder, to the disk, so that they survive a power failure."""
    if sys.platform == "win32" and path.is_dir():  # it cannot be opened there
        return
    file = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(file)
    finally:
        os.close(file)

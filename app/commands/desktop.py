"""`svwfs desktop`: the entry of svwfs in the menu of a Linux desktop, or in the start menu of Windows."""

import re
import sys
import sysconfig
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from app.commands import options
from app.errors import InputError, RunError
from app.files import write_whole

_ENTRY = """[Desktop Entry]
Type=Application
Name=svwfs
GenericName=Wavefront sensor
Comment=Live wavefronts at every position of the field
Exec={command}
Icon=svwfs
Terminal=false
Categories=Science;Physics;
StartupWMClass=svwfs
"""


def desktop(
    *,
    bench: Annotated[str | None, options.bench_option("Bench file or preset that the entry opens.")] = None,
    remove: Annotated[bool, typer.Option("--remove", help="Remove the entry.")] = False,
) -> None:
    """Add svwfs to the menu of a Linux desktop or to the start menu of Windows, for the present user.

    The entry starts svwfs-window: the window without a terminal, with errors in a dialog.

    Example: svwfs desktop --bench bench.toml
    """
    if not remove:
        typer.echo(f"entry: {add_entry(bench)}")
        return
    made = _files()
    if not made[0].exists():
        raise InputError(f"{made[0]}: no such entry")
    for path in made:
        path.unlink(missing_ok=True)


def add_entry(bench: str | None) -> Path:
    """Add the entry for the present user, replacing an older one, and return its file.

    It opens a bench file or preset; None is the command's own default. `InputError` if that cannot be used, or this is
    macOS, `RunError` if `svwfs-window` is not installed, or the entry cannot be written.
    """
    from app.bench.bench_files import bench_file
    from app.bench.config import load_bench

    is_windows = sys.platform == "win32"
    program = Path(sysconfig.get_path("scripts"), "svwfs-window.exe" if is_windows else "svwfs-window")
    if sys.platform == "darwin":
        raise InputError(f"an entry cannot be made on macOS: make a shortcut to {program} by hand")
    if not program.exists():
        raise RunError(f"{program}: no such program; install svwfs with uv, pipx or pip")
    words = [str(program)]
    if bench is not None:
        load_bench(bench)
        words += ["--bench", bench if bench_file(bench) != Path(bench) else str(Path(bench).absolute())]
    entry, *icons = _files()
    if is_windows:
        from app.gui.shortcut import id_list, shortcut

        icon = Path(str(files("app.gui") / "svwfs.ico"))
        write_whole(entry, shortcut(program, id_list(program), words[1:], folder=Path.home(), icon=icon))
    else:
        write_whole(icons[0], (files("app.gui") / "svwfs.svg").read_bytes())
        write_whole(entry, _ENTRY.format(command=" ".join(map(_quoted, words))))
    return entry


def _files() -> tuple[Path, ...]:
    """The entry, and the icon if it is copied."""
    import platformdirs

    data = platformdirs.user_data_path(roaming=True)
    if sys.platform == "win32":
        return (data / "Microsoft" / "Windows" / "Start Menu" / "Programs" / "svwfs.lnk",)
    return data / "applications" / "svwfs.desktop", data / "icons" / "hicolor" / "scalable" / "apps" / "svwfs.svg"


def _quoted(word: str) -> str:
    """Quote a word as the Desktop Entry Specification says: escaped in quotes, then as any text."""
    return '"' + re.sub(r'(["`$\\])', r"\\\1", word).replace("\\", "\\\\").replace("%", "%%") + '"'

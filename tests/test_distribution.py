"""Source distribution and wheel: complete, and at work in an environment of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from support.paths import ROOT
from support.patience import HANG_S

pytestmark = pytest.mark.slow
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
EXTRAS = {  # by what they make possible; hcipy is not installed here
    "batch": "bokeh, distributed",
    "genicam": "drivers.genicam._library",
    "mask": "ezdxf, gdstk",
    "micro-manager": "pymmcore, drivers.micro_manager._core",
    "peers": "SimpleITK, pyrtc.slopes_process, skimage, reconstruction.registration.itk_affine",
}
PACKAGES = {"app", "drivers", "reconstruction", "simulated_devices", "svwfs"}
USER_CODE = """
import svwfs
from reconstruction.geometry import Lattice

count: str = svwfs.load_bench("small_demo").sensor.lenslet_rows
lattice: int = Lattice
"""
EXAMPLES = Path(__file__).parent / "support" / "python_examples.py"


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command without the project's folder on Python's path; return its output."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    told = subprocess.run(  # noqa: S603 - our own
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=HANG_S, check=False
    )
    assert told.returncode == 0, told.stdout + told.stderr
    return told.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The unpacked source distribution."""
    folder = tmp_path_factory.mktemp("source")
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", folder, cwd=ROOT)
    with tarfile.open(folder / f"svwfs-{VERSION}.tar.gz") as archive:
        archive.extractall(folder, filter="data")
    return folder / f"svwfs-{VERSION}"


@pytest.fixture(scope="module")
def wheel(source: Path) -> Path:
    """The wheel, built from the source distribution."""
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", source.parent, cwd=source)
    return source.parent / f"svwfs-{VERSION}-py3-none-any.whl"


@pytest.fixture(scope="module")
def programs(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Programs of an environment with the wheel alone; its dependencies are those of this environment."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    names = {"base": str(folder), "platbase": str(folder)}
    packages, scripts = (Path(sysconfig.get_path(name, "venv", names)) for name in ("purelib", "scripts"))
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))  # which reads no .pth file there
    pip = ("-m", "pip", "--python", scripts / "python", "install", "--no-deps", "--no-index")
    run(sys.executable, *pip, wheel, cwd=folder)
    return scripts


def test_wheel_has_what_it_needs_and_no_tests(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    needed = {
        "svwfs/__init__.py",
        "app/docs/window.md",
        "app/docs/window.png",
        "app/gui/svwfs.svg",
        "app/cli/window.py",
    }
    needed |= {f"app/bench/presets/{path.name}" for path in (ROOT / "app" / "bench" / "presets").glob("*.toml")}
    needed |= {f"{package}/py.typed" for package in PACKAGES}
    assert needed <= set(names)
    assert {name.split("/")[0] for name in names if name.endswith(".py")} == PACKAGES
    assert not [name for name in names if name.startswith("tests/")]


@pytest.mark.long
def test_source_passes_tests(source: Path) -> None:
    tests = ("tests/app/bench", "tests/drivers/test_device_states.py", "tests/reconstruction/modes")
    assert " passed" in run(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests, cwd=source)


@pytest.mark.long
def test_installed_programs_work(programs: Path, tmp_path: Path) -> None:
    assert run(programs / "svwfs", "--version", cwd=tmp_path) == f"svwfs {VERSION}\n"
    assert (programs / "svwfs-window").exists()
    run(programs / "svwfs", "selftest", cwd=tmp_path)
    run(programs / "python", EXAMPLES, cwd=tmp_path)


@pytest.mark.long
def test_type_checker_sees_types_from_outside(programs: Path, tmp_path: Path) -> None:
    (tmp_path / "user.py").write_text(USER_CODE)
    checker = ("-m", "mypy", "--strict", "--python-executable", programs / "python", "user.py")
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    told = subprocess.run(  # noqa: S603 - our own
        [sys.executable, *checker], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    ).stdout
    assert 'variable has type "str")' in told, told
    assert 'variable has type "int")' in told, told
    assert "Found 2 errors in 1 file" in told, told


def test_every_extra_can_be_imported(programs: Path, tmp_path: Path) -> None:
    assert set(EXTRAS) == set(
        tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    )
    for modules in EXTRAS.values():
        run(programs / "python", "-c", f"import {modules}", cwd=tmp_path)

"""Source distribution and wheel: complete, and at work in an environment of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from support.paths import ROOT
from support.patience import HANG_S

VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
EXTRAS = {  # by what they make possible
    "batch": "distributed",
    "genicam": "drivers.genicam._library",
    "mask": "ezdxf, gdstk",
    "micro-manager": "pymmcore, drivers.micro_manager._core",
    "peers": "SimpleITK, reconstruction.registration.itk_affine",
    "usb": "libusb_package",
}
PACKAGES = {"app", "drivers", "reconstruction", "simulated_devices", "svwfs"}
USER_CODE = """
import svwfs
from reconstruction.geometry import Lattice

count: str = svwfs.load_bench("small_demo").sensor.lenslet_rows
lattice: int = Lattice
"""
OWN_FILES = ("app.py", "reconstruction.py", "drivers/__init__.py", "simulated_devices/own.py")
BESIDE_OWN_FILES = """
import svwfs

if __name__ == "__main__":
    import app, drivers.light_source, simulated_devices
    from app.acquisition.watchdog_light import WatchdogLight

    try:
        WatchdogLight(drivers.light_source.ManualLightSettings())
    except svwfs.WrongState as error:  # from the other process: nobody has switched the light off
        assert "confirm" in str(error)
    print(svwfs.load_bench("small_demo").sensor.lenslet_rows)
"""
CHILDREN = """
import multiprocessing, time

import svwfs

if __name__ == "__main__":
    from app.acquisition.remote.own_instrument import OwnInstrument
    from app.batch.workers import workers
    from app.measurement.background_estimator import BackgroundEstimatorProcess

    bench = svwfs.load_bench("small_demo")
    images = svwfs.simulate(bench)
    reconstruct = svwfs.reconstructor(bench, images.reference, dark=images.dark)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        one = pool.map(reconstruct, images.frames)[0]
    with workers(1, None) as evaluate:
        ((_, other),) = evaluate(reconstruct, images.frames)
    assert (one.views == other.views).all()
    estimator = BackgroundEstimatorProcess(reconstruct._prepared())
    estimator.prepare()
    estimator.close()
    with OwnInstrument("beside") as own:
        connection = own.connect(bench)
        while connection.is_alive and not connection.is_reached:
            time.sleep(0.05)
        assert connection.is_alive, connection.loss
    print("done")
"""
EXAMPLES = Path(__file__).parent / "support" / "python_examples.py"


def run(*command: str | Path, cwd: Path, path: str = "") -> str:
    """Run a command with this PYTHONPATH; return its output."""
    environment = os.environ | {"PYTHONPATH": path, "PYTHONSAFEPATH": ""}  # which a test of main() may have set
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
    import venv  # noqa: PLC0415 - the Python of `make windows` lacks it

    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    names = {"base": str(folder), "platbase": str(folder)}
    packages, scripts = (Path(sysconfig.get_path(name, "venv", names)) for name in ("purelib", "scripts"))
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))  # which reads no .pth file there
    pip = ("-m", "pip", "--python", scripts / "python", "install", "--no-deps", "--no-index")
    run(sys.executable, *pip, wheel, cwd=folder)
    return scripts


@pytest.mark.slow
def test_wheel_has_what_it_needs_and_no_tests(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    needed = {
        "svwfs/__init__.py",
        "app/docs/evidence/index.md",
        "app/docs/troubleshooting.md",
        "app/docs/window.md",
        "app/docs/window.png",
        "app/gui/citation.txt",
        "app/gui/conventions.html",
        "app/gui/svwfs.svg",
        "app/cli/window.py",
    }
    needed |= {f"app/bench/presets/{path.name}" for path in (ROOT / "app" / "bench" / "presets").glob("*.toml")}
    needed |= {f"{package}/py.typed" for package in PACKAGES}
    assert needed <= set(names)
    assert {name.split("/")[0] for name in names if name.endswith(".py")} == PACKAGES
    assert not [name for name in names if name.startswith("tests/")]


@pytest.mark.slow
@pytest.mark.long
def test_source_passes_tests(source: Path) -> None:
    tests = ("tests/app/bench", "tests/drivers/test_device_states.py", "tests/reconstruction/modes")
    assert " passed" in run(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests, cwd=source)


@pytest.mark.slow
@pytest.mark.long
def test_installed_programs_work(programs: Path, tmp_path: Path) -> None:
    assert run(programs / "svwfs", "--version", cwd=tmp_path) == f"svwfs {VERSION}\n"
    assert (programs / "svwfs-window").exists()
    run(programs / "svwfs", "selftest", cwd=tmp_path)
    run(programs / "python", EXAMPLES, cwd=tmp_path)


@pytest.mark.slow
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


@pytest.mark.slow
def test_every_extra_can_be_imported(programs: Path, tmp_path: Path) -> None:
    assert set(EXTRAS) == set(
        tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    )
    for modules in EXTRAS.values():
        run(programs / "python", "-c", f"import {modules}", cwd=tmp_path)


@pytest.fixture(params=["checkout", "editable", pytest.param("wheel", marks=[pytest.mark.slow, pytest.mark.long])])
def python(request: pytest.FixtureRequest) -> tuple[Path, str]:
    """A Python with svwfs, and the PYTHONPATH that it needs."""
    if request.param == "wheel":
        return request.getfixturevalue("programs") / "python", ""
    return Path(sys.executable), str(ROOT) if request.param == "checkout" else ""


@pytest.fixture
def own_files(tmp_path: Path) -> Path:
    """A folder in which a user has modules with the names of our packages."""
    for name in OWN_FILES:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / "script.py").write_text(BESIDE_OWN_FILES)
    return tmp_path


def test_import_works_beside_own_modules_of_these_names(python: tuple[Path, str], own_files: Path) -> None:
    program, path = python
    assert run(program, "script.py", cwd=own_files, path=path) == "7\n"
    assert run(program, "-c", BESIDE_OWN_FILES, cwd=own_files, path=path) == "7\n"  # as in a notebook


def test_error_names_an_own_module_that_was_imported_first(python: tuple[Path, str], own_files: Path) -> None:
    program, path = python
    asks = "try: import {}, svwfs\nexcept ImportError as error: print(error)"
    for module, file in (
        ("app", "app.py"),
        ("reconstruction", "reconstruction.py"),
        ("drivers", "drivers/__init__.py"),
    ):
        found = run(program, "-c", asks.format(module), cwd=own_files, path=path)
        assert f"a package '{module}', but {own_files / file} was" in found


@pytest.mark.slow
@pytest.mark.long
def test_child_processes_work_beside_own_modules(python: tuple[Path, str], own_files: Path) -> None:
    program, path = python
    (own_files / "children.py").write_text(CHILDREN)
    assert run(program, "children.py", cwd=own_files, path=path) == "done\n"
    shared = os.pathsep.join(filter(None, [str(own_files), path]))
    assert run(program.with_name("svwfs"), "--version", cwd=own_files, path=shared) == f"svwfs {VERSION}\n"

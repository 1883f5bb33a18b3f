"""The product for Windows and macOS, which no test runs on: it uses nothing that exists on Linux only."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT
from support.patience import HANG_S

PACKAGES = ["app", "drivers", "reconstruction", "simulated_devices"]
SOURCES = sorted(path for name in PACKAGES for path in (ROOT / name).rglob("*.py"))
MODULES = sorted({".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in SOURCES})
PATHS_OF_ONE_SYSTEM = {
    "app/acquisition/streams/ring.py": {"/proc/"},
    "app/commands/display.py": {"/tmp/.X11-unix/X"},  # noqa: S108 - asked on Linux only
    "app/run_facts.py": {"/proc/cpuinfo"},
    "drivers/genicam/_library.py": {"/opt/homebrew/lib/libaravis-0.8.dylib", "/usr/local/lib/libaravis-0.8.dylib"},
    "drivers/usb_lights/_usbtmc.py": {"/etc/udev/rules.d/70-svwfs.rules"},
}

WITHOUT_POSIX = """
import importlib, sys
from support.without_posix import hide_posix

hide_posix()
sys.platform = "win32"
sys.modules["msvcrt"] = type(sys)("msvcrt")  # of Windows
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


def loaded(*arguments: str) -> str:
    """Run Python with the tests' support in its path, and return what it prints."""
    told = subprocess.run(  # noqa: S603 - our own
        [sys.executable, *arguments],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT / "tests")},
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert told.returncode == 0, told.stdout + told.stderr
    return told.stdout


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("system", ["win32", "darwin"])
def test_every_function_of_python_exists_there(system: str, tmp_path: Path) -> None:
    """Mypy knows the standard library of each system; what `sys.platform` guards is not checked."""
    arguments = ["--config-file", "/dev/null", "--no-site-packages", "--ignore-missing-imports"]
    arguments += ["--platform", system, "--cache-dir", str(tmp_path)]
    command = [sys.executable, "-m", "mypy", *arguments, *map(str, SOURCES), str(ROOT / "svwfs.py")]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=HANG_S, check=False)  # noqa: S603 - our own
    assert f"checked {len(SOURCES) + 1} source files" in told.stdout
    missing = [line for line in told.stdout.splitlines() if "Module " in line and "has no attribute" in line]
    assert not missing


@pytest.mark.slow
@pytest.mark.long
def test_modules_import_without_posix() -> None:
    loaded("-c", WITHOUT_POSIX, *MODULES)


@pytest.mark.slow
@pytest.mark.long
def test_tests_load_without_posix() -> None:
    """All of them, so that only the mark `posix` leaves tests out on Windows."""
    collect = ["-m", "pytest", "-p", "no:cacheprovider", "--collect-only", "-q", "tests"]
    assert listed_tests(loaded(*collect, "-p", "support.without_posix")) == listed_tests(loaded(*collect))


def listed_tests(listed: str) -> list[str]:
    found = [line.partition("[")[0] for line in listed.splitlines() if "::" in line]  # a signal has another number
    assert len(found) > 4000
    return found


def test_paths_of_one_system_are_known() -> None:
    found: dict[str, set[str]] = {}
    for path in SOURCES:
        tree = ast.parse(path.read_text("utf-8"))
        texts = {
            node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
        }
        beginnings = tuple(
            f"/{folder}/" for folder in ("dev", "etc", "home", "opt", "proc", "run", "sys", "tmp", "usr", "var")
        )
        if named := {text for text in texts if text.startswith(beginnings)}:
            found[path.relative_to(ROOT).as_posix()] = named
    assert found == PATHS_OF_ONE_SYSTEM

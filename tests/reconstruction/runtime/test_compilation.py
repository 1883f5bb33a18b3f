"""On-disk cache of compiled code."""

from __future__ import annotations

import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import pytest
from support.patience import HANG_S

import reconstruction
from reconstruction.runtime.compilation import _imported, compiled
from simulated_devices.optics.compiled import compiled as simulator_compiled

PROGRAM = """
from reconstruction.sum import with_addend
print(with_addend(1.0))
"""
FILES = {
    "addend.py": "ADDEND = 0.5",
    "sum.py": """
from reconstruction.addend import ADDEND
from reconstruction.runtime.compilation import compiled


@compiled
def with_addend(x: float) -> float:
    return x + ADDEND
""",
}


@pytest.mark.parametrize("compiled", [compiled, simulator_compiled], ids=["reconstruction", "simulator"])
def test_code_is_compiled_uncached_where_no_cache_can_be_written(
    compiled: Callable[[Callable[[float], float]], Callable[[float], float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    njit = numba.njit

    def without_folder(*functions: Any, **options: Any) -> Any:
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*functions, **options)

    def double(x: float) -> float:
        return 2 * x

    monkeypatch.setattr(numba, "njit", without_folder)
    assert compiled(double)(21.0) == 42.0


@pytest.mark.slow
def test_changed_constant_of_another_file_triggers_recompilation(tmp_path: Path) -> None:
    package = tmp_path / "reconstruction"
    shutil.copytree(Path(str(reconstruction.__file__)).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    for name, text in FILES.items():
        (package / name).write_text(text)
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def result() -> float:
        command = [sys.executable, "-c", PROGRAM]
        finished = subprocess.run(  # noqa: S603 - this interpreter
            command, env=environment, capture_output=True, text=True, timeout=HANG_S, check=True, cwd=tmp_path
        )
        return float(finished.stdout.strip(" []\n"))

    before = result()
    for index in (tmp_path / "cache").rglob("*.nbi"):  # as if it named a class that the next version does not have
        with index.open("rb") as file:
            version = pickle.load(file)  # noqa: S301 - Numba wrote it
        index.write_bytes(pickle.dumps(version) + b"creconstruction\nRemoved\n.")
    # Of another length, because Python misses an edit of equal length within the same second.
    (package / "addend.py").write_text("ADDEND = 3")
    assert before == 1.5
    assert result() == 4.0


def test_code_depends_on_few_files() -> None:
    """It is compiled anew after an edit of any file that its own imports, directly or through others."""
    package = Path(reconstruction.__file__).parent
    marked = re.compile(r"^@(compiled|inlined)$", re.MULTILINE)
    kernels = [path for path in package.rglob("*.py") if marked.search(path.read_text("utf-8"))]
    assert len(kernels) > 5
    for kernel in kernels:
        waiting, read = [kernel], set[Path]()
        while waiting:
            if (path := waiting.pop()) not in read and path.is_file():
                read.add(path)
                waiting += _imported(path)
        assert len(read) <= 8, kernel


@pytest.mark.slow
@pytest.mark.parametrize("text", ["CACHE_DIR: stolen", "DISABLE_JIT: 1", "x: ["])
def test_file_of_the_working_folder_configures_no_compiler(tmp_path: Path, text: str) -> None:
    """It could name a cache, whose files are unpickled."""
    (tmp_path / ".numba_config.yaml").write_text(text)
    program = (
        "import reconstruction.runtime.counters as c, numba; print(c.take(c.new_counters()), numba.config.CACHE_DIR)"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(reconstruction.__file__).parents[1]), "NUMBA_DISABLE_JIT": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-W", "error", "-c", program]
    finished = subprocess.run(  # noqa: S603 - this interpreter
        command, env=environment, capture_output=True, text=True, timeout=HANG_S, check=False, cwd=tmp_path
    )
    assert (finished.stdout.strip(), finished.stderr) == ("0", "")
    assert [each.name for each in tmp_path.iterdir()] == [".numba_config.yaml"]

"""Files of the working folder: no library that is loaded takes them for its configuration, or for code."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT
from support.patience import HANG_S

_MATPLOTLIB = re.compile(r"^ *(from|import) matplotlib", re.MULTILINE)


def printed_in(folder: Path, program: str) -> str:
    """Return what a program prints that runs in a folder."""
    command = [sys.executable, "-P", "-W", "error", "-c", program]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    finished = subprocess.run(  # noqa: S603 - this interpreter
        command, env=environment, capture_output=True, text=True, timeout=HANG_S, check=False, cwd=folder
    )
    assert finished.stderr == ""
    return finished.stdout.strip()


@pytest.mark.slow
def test_figures_are_drawn_by_no_settings_found_there(tmp_path: Path) -> None:
    (tmp_path / "matplotlibrc").write_text("figure.dpi: 7\ntext.usetex: true\nno such key\n")
    program = "from app.plotting import Figure; import matplotlib as m; print(m.rcParams['text.usetex'], Figure().dpi)"
    assert printed_in(tmp_path, program) == "False 100.0"


def test_matplotlib_is_loaded_by_one_module_first() -> None:
    """Only what a type checker reads may come before."""
    for path in (ROOT / "app").rglob("*.py"):
        text = re.sub(r"if TYPE_CHECKING:\n(    .*\n|\n)*", "", path.read_text("utf-8"))
        if path.name != "plotting.py" and (first := _MATPLOTLIB.search(text)):
            assert "from app.plotting import" in text[: first.start()], path


@pytest.mark.slow
def test_drawings_are_made_by_no_settings_found_there(tmp_path: Path) -> None:
    pytest.importorskip("ezdxf")
    (tmp_path / "ezdxf.ini").write_text("no section")
    program = (
        "from app.cli import main; import sys; sys.argv[1:] = 'mask square --size 1mm --out mask.dxf'.split(); main()"
    )
    printed_in(tmp_path, program)
    assert (tmp_path / "mask.dxf").stat().st_size > 1000


@pytest.mark.posix  # only its loader knows the variable
def test_child_processes_load_no_library_found_there(tmp_path: Path) -> None:
    """An empty entry of the variable means the working folder."""
    program = "import os, reconstruction.frame.pixels; print(os.environ['LD_LIBRARY_PATH'])"
    folders = printed_in(tmp_path, program)
    assert not folders or all(map(os.path.isabs, folders.split(":")))

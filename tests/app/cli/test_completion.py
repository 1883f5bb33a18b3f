"""Shell completion of commands and options, as bash asks for it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.patience import HANG_S

SVWFS = Path(sys.executable).with_name("svwfs")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None or not SVWFS.exists(), reason="needs bash and an installed svwfs")
@pytest.mark.parametrize(
    ("typed", "completed"),
    [(["rep"], {"replay", "report"}), (["replay", "--ver"], {"--verify"}), (["paper", "tab"], {"table1", "table2"})],
)
def test_bash_completes(typed: list[str], completed: set[str], tmp_path: Path) -> None:
    script = subprocess.run(  # noqa: S603 - our own program
        [SVWFS], env={**os.environ, "_SVWFS_COMPLETE": "source_bash"}, capture_output=True, timeout=HANG_S, check=False
    ).stdout
    (tmp_path / "completion.sh").write_bytes(script)
    words = " ".join(["svwfs", *typed])
    asking = f"source completion.sh; COMP_WORDS=({words}); COMP_CWORD={len(typed)}; _svwfs_completion"
    told = subprocess.run(  # noqa: S603 - our own text
        ["bash", "-c", f"{asking} svwfs {typed[-1]}; printf '%s\\n' \"${{COMPREPLY[@]}}\""],  # noqa: S607 - any bash
        env={**os.environ, "PATH": f"{SVWFS.parent}{os.pathsep}{os.environ['PATH']}"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=True,
    )
    assert set(told.stdout.split()) == completed

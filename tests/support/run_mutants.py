"""`make mutants`: put each fault of mutants.toml into a copy of the source; the tests named there must fail."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_IGNORED = shutil.ignore_patterns("__pycache__", ".*", "build")
_HANG_S = 200  # for a test
_FAILED = 1  # exit status of pytest if a test failed; others mean that none was run


def main(rooms: list[str]) -> int:
    """Try the faults of these rooms, or of all; return the number of those that no test found."""
    faults = tomllib.loads((ROOT / "tests" / "support" / "mutants.toml").read_text("utf-8"))
    survivors = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "svwfs"
        shutil.copytree(ROOT, copy, ignore=_IGNORED)
        for room in rooms or faults:
            for name, text, fault, tests in faults[room]["faults"]:
                began_s, is_found = time.monotonic(), found(copy, name, text, fault, f"{faults[room]['tests']}/{tests}")
                survivors += not is_found
                verdict = "found" if is_found else "LIVES"
                sys.stdout.write(f"{verdict} {time.monotonic() - began_s:4.0f} s  {name}: {fault.strip()}\n")
                sys.stdout.flush()
    sys.stdout.write(f"{survivors} live\n")
    return survivors


def found(copy: Path, name: str, text: str, fault: str, tests: str) -> bool:
    """Return whether a test fails with the fault; `SystemExit` if the text is not found once."""
    path = copy / name
    source = path.read_text("utf-8") if path.exists() else ""
    if source.count(text) != 1:
        sys.exit(f"{name}: {text!r} is there {source.count(text)} times, not once: mend mutants.toml")
    path.write_text(source.replace(text, fault), "utf-8")
    # A long test is run by nobody else every day, so it may not be the one that finds a fault.
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not long", "-p", "no:cacheprovider", tests]
    command += [f"--timeout={_HANG_S}", "--timeout-method=thread"]  # a hang is found, too, also if no signal ends it
    environment = os.environ | {"PYTHONPATH": str(copy), "QT_QPA_PLATFORM": "offscreen", "OPENBLAS_NUM_THREADS": "1"}
    environment["SVWFS_HANG_S"] = "20"
    try:
        finished = subprocess.run(  # noqa: S603 - this interpreter
            command, cwd=copy, env=environment, capture_output=True, text=True, check=False
        )
    finally:
        path.write_text(source, "utf-8")
    if finished.returncode not in {0, _FAILED}:
        sys.exit(f"{name}: {fault!r}: pytest ran no test:\n{finished.stdout[-2000:]}{finished.stderr[-2000:]}")
    return finished.returncode == _FAILED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]) > 0)

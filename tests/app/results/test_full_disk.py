"""Results on a disk that fills up: HDF5 would crash the process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.paths import FOREIGN_FRAMES

# A limit on the size of files stands for the size of the disk; HDF5 would write to it and crash.
_PROGRAM = """
import resource, sys
from pathlib import Path
import numpy as np, xarray as xr
from app.bench.config import load_bench
from app.errors import RunError
from app.results.result_file import write_pieces

room, out = int(sys.argv[1]), Path(sys.argv[2])
bench = load_bench("small_demo")
pieces = [xr.Dataset({"wavefront": (("frame", "x"), np.random.default_rng(n).normal(size=(8, 512)))}) for n in range(5)]
resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
try:
    write_pieces(out, pieces, bench=bench, inputs={})
except RunError as error:
    print(error)
    sys.exit(1)
"""


def write(room: int, out: Path) -> subprocess.CompletedProcess[str]:
    """Write 5 pieces of 8 frames where a file may have `room` bytes."""
    command = [sys.executable, "-c", _PROGRAM, str(room), str(out)]
    return subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - our own program


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> int:
    """Size of the complete file."""
    out = tmp_path_factory.mktemp("whole") / "results.nc"
    done = write(10**8, out)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    with xr.open_dataset(out) as results:
        expected = np.concatenate([np.random.default_rng(n).normal(size=(8, 512)) for n in range(5)])
        np.testing.assert_array_equal(results["wavefront"], expected)
    return out.stat().st_size


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("share", [0.01, 0.3, 0.5, 0.7, 0.9, 0.999])
def test_full_disk_is_one_line_and_no_file(whole: int, share: float, tmp_path: Path) -> None:
    out = tmp_path / "results.nc"
    done = write(int(share * whole), out)
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout == f"{out}: cannot be written: File too large\n"
    assert not list(tmp_path.iterdir())


# A new user namespace may mount a disk of 64 kB.
_ON_SMALL_DISK = """
mount -t tmpfs -o size=64k disk "$0" && cd "$0" || exit 77
"$@"
status=$?
ls -A
exit $status
"""
_PROGRAM_OF_COMMANDS = "from app.cli import main; main()"


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("option", ["--out", "--plot"])
def test_reconstruct_on_a_full_disk_is_one_line_and_no_file(tmp_path: Path, option: str) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    out, plot = (disk / "r.nc", None) if option == "--out" else (tmp_path / "r.nc", disk / "p.png")
    frames = [str(FOREIGN_FRAMES / name) for name in ("square_frame.tif", "square_reference.tif", "bench.toml")]
    command = [sys.executable, "-c", _PROGRAM_OF_COMMANDS, "reconstruct", frames[0], "--reference", frames[1]]
    command += ["--bench", frames[2], "--set", "registration.warp=affine", "--out", str(out)]
    command += [] if plot is None else ["--plot", str(plot)]
    isolated = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", _ON_SMALL_DISK, str(disk), *command]
    done = subprocess.run(isolated, capture_output=True, text=True, check=False)  # noqa: S603 - our own program
    if done.returncode == 77 or "unshare:" in done.stderr:
        pytest.skip("this system lets nobody mount a disk")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"svwfs: {out if plot is None else plot}: cannot be written: No space left on device\n"

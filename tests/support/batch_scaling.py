"""Measure batches: workers against one worker, memory, size, and equality with a single process.

    OPENBLAS_NUM_THREADS=1 PYTHONPATH=tests python -m support.batch_scaling --frames 2000 --rounds 3

takes some minutes with the bench `small_demo`. Runs with one worker and with more alternate, so that another load hits
both; workers are started before the clock.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

from app.batch.run import run_batch
from app.batch.store import BatchJob
from app.batch.workers import workers
from app.recording.reader import Recording
from support.batches import files_of, one_by_one
from support.recordings import record


def _peak_mb() -> float:
    """Most memory that this process ever had; `getrusage` would count that of its parent, too."""
    peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(peak.split()[1]) * 1024 / 1e6


def run_once(recording: Recording, out: Path, count: int) -> tuple[float, float]:
    """Return the seconds of a batch, and the most memory of a worker, MB."""
    with workers(count, None) as started:
        started._client.wait_for_workers(count)
        list(started(os.getenv, ["HOME"] * 4 * count))  # the processes are up
        begun_s = time.perf_counter()
        made = run_batch([recording.folder], out, BatchJob(), started, lambda *_: None)
        seconds = time.perf_counter() - begun_s
        assert made.wavefronts == len(recording)
        return seconds, max(started._client.run(_peak_mb).values())


def main() -> None:
    """Print times, ratio, memory and size."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--bench", default="small_demo")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--recording", type=Path, help="an existing one instead")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recording = (
            Recording(given.recording)
            if given.recording is not None
            else record(given.bench, Path(folder) / "run", "reconstruction.refine=false", frames=given.frames)
        )
        alone = Path(folder) / "alone.zarr"
        run_batch([recording.folder], alone, BatchJob(), one_by_one, lambda *_: None)
        expected = {name: contents for name, (_, contents) in files_of(alone).items()}
        stored_mb = sum(map(len, expected.values())) / 1e6 / len(recording)
        _say(f"{len(recording)} frames; results {stored_mb:.3f} MB and {len(expected) / len(recording):.2f} files each")
        ratios = []
        for turn in range(given.rounds):
            seconds: dict[int, float] = {}
            for count in (1, given.workers) if turn % 2 else (given.workers, 1):
                out = Path(folder) / f"{turn}-{count}.zarr"
                seconds[count], peak_mb = run_once(recording, out, count)
                same = {name: contents for name, (_, contents) in files_of(out).items()} == expected
                rate_hz = len(recording) / seconds[count] / count
                _say(
                    f"{count} workers: {seconds[count]:.1f} s, {rate_hz:.1f} frames/s and worker, {peak_mb:.0f} MB,"
                    f" {'identical' if same else 'DIFFERENT'}; load {os.getloadavg()[0]:.1f}"
                )
            ratios.append(seconds[1] / seconds[given.workers])
        _say(f"{given.workers} workers are {statistics.median(ratios):.2f} times as fast as one (median)")


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()

"""`run.json` of a run that recorded nothing: what became of its frames, and how long every stage took."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from app.acquisition.worker import Acquisition
from app.run_facts import now, software_facts, timing_facts, write_record


def write_run(path: Path, command: str, acquisition: Acquisition) -> None:
    """Write it for what an acquisition has done."""
    shown = acquisition.timings.summary()["draw"].count
    record = {
        "command": command,
        "ended": now(),
        "frames": {**asdict(acquisition.counts), "shown": shown},
        "timings": timing_facts(acquisition.timings),
        **software_facts(),
    }
    write_record(path, record)

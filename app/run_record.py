"""`run.json`: what a run was, what became of its frames, and how long every stage took."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from app.acquisition import Acquisition
from app.files import appearing_whole
from app.machine import machine_facts, versions
from app.timing import STAGES


def write_run(path: Path, command: str, acquisition: Acquisition) -> None:
    """Write it for what an acquisition has done; times in s, of every stage median, 99th percentile and maximum."""
    counts, summaries = acquisition.counts, acquisition.timings.summary()
    timings = {
        stage: {name: None if math.isnan(value) else value for name, value in asdict(summaries[stage]).items()}
        for stage in STAGES
    }
    record = {
        "command": command,
        "ended": datetime.now(UTC).isoformat(timespec="seconds"),
        "frames": {**asdict(counts), "shown": summaries["draw"].count},
        "timings": timings,
        "versions": versions(),
        "machine": machine_facts(),
    }
    with appearing_whole(path) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n")

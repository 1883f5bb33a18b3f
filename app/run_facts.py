"""What `run.json` says of any run: when, with what software and computer, and how long every stage took."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from app.files import appearing_whole
from app.host import machine_facts, versions
from app.timing import STAGES, Timings


def now() -> str:
    """The present moment, UTC, as ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def software_facts() -> dict[str, Any]:
    """Versions of the software, and the computer."""
    return {"versions": versions("zarr"), "machine": machine_facts()}


def timing_facts(timings: Timings) -> dict[str, dict[str, float | None]]:
    """Of every stage count, median, 99th percentile and maximum, s; None where there is nothing to say."""
    summaries = timings.summary()
    return {
        stage: {name: None if math.isnan(value) else value for name, value in asdict(summaries[stage]).items()}
        for stage in STAGES
    }


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON; it appears whole."""
    with appearing_whole(path) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", "utf-8")

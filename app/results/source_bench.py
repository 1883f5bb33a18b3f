"""Bench of a recording or of a file of results, and what an earlier version meant by it."""

from pathlib import Path

from app.bench.config import Bench, parse_bench
from app.bench.earlier_versions import neglected_propagation
from app.recording.reader import Recording
from app.results.dataset import reading_results


def read_bench_of(source: Path, settings: tuple[str, ...] = ()) -> Bench:
    """Return the bench of results or of a recording, changed by "section.key=value"."""
    return parse_bench(_text_of(source), f"{source}: bench", settings, is_recorded=True)


def version_notice(source: Path, settings: tuple[str, ...] = ()) -> str:
    """Say that the version of results or of a recording neglected propagation; empty if not, or if settings do not."""
    notice = neglected_propagation(_text_of(source))
    return notice if notice and read_bench_of(source, settings).field.neglect_propagation else ""


def _text_of(source: Path) -> str:
    if source.is_dir():
        return str(Recording(source).run["bench"])
    with reading_results(source) as results:
        return str(results.attrs.get("bench", ""))

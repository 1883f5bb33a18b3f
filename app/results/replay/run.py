"""A recording once more through the pipeline: what `svwfs replay` does."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from app.bench.config import Bench
from app.errors import InputError, RunError
from app.progress import Progress
from app.recording.reader import Recording
from app.recording.reprocess import Change, Reprocessed, reprocess
from app.results.dataset import write_pieces
from app.results.replay.change import change_of
from app.results.replay.comparison import Comparison
from app.results.replay.results import results_in_pieces
from app.results.replay.verification import Verification
from app.results.view_quality import Variable
from reconstruction.runtime.threads import one_blas_thread


@dataclass(slots=True)
class Replay:
    """What has come of a replay: a verification with the recorded bench, a comparison with another."""

    verification: Verification | None
    comparison: Comparison | None
    frames: int = 0
    reconstructed: int = 0
    unrefined: int = 0  # frames that were refined when they were recorded, and are not by this bench
    problem: str = ""  # of the first frame that could not be reconstructed

    def take(self, frame: Reprocessed) -> None:
        """Count one frame."""
        self.frames += 1
        self.reconstructed += frame.wavefront is not None
        self.unrefined += frame.wavefront is not None and frame.line.bias is not None and not frame.is_refined
        self.problem = self.problem or frame.problem


def replay(
    folder: Path,
    *,
    bench: str | None,
    settings: tuple[str, ...],
    frames: str | None,
    out: Path | None,
    verify: bool,
    progress: Progress,
) -> Replay:
    """Reconstruct recorded frames once more and write the results to `out`, if it is given.

    With another `bench`, or `settings` of the recorded one changed, both are made and compared. To `verify` is to raise
    a `RunError` when anything differs from what was recorded.
    """
    recording = Recording(folder)
    chosen = recording.select(frames)
    change = change_of(bench, settings)
    if verify and change is not None:
        raise InputError("--verify asks whether the recorded bench makes the same again: leave --bench and --set out")
    made = Replay(Verification(recording) if change is None else None, None if change is None else Comparison())
    with one_blas_thread():
        stream = _frames(recording, chosen, change, made, progress)
        if out is not None:
            write_pieces(
                out,
                results_in_pieces(stream),
                bench=first_bench(recording, chosen, change),
                inputs={"recording": recording.folder.name},
            )
        for _ in stream:
            pass
    if verify and made.verification is not None and not made.verification.passes:
        raise RunError(f"{folder}: {made.verification.sentence}")
    return made


def _frames(
    recording: Recording, chosen: range, change: Change | None, made: Replay, progress: Progress
) -> Iterator[tuple[Reprocessed, Mapping[str, Variable]]]:
    """Make frame after frame, as recorded or both ways, and pass on what is to be written of each."""
    originals = reprocess(recording, chosen)
    others = originals if change is None else reprocess(recording, chosen, change)
    for done, frame in enumerate(others, 1):
        more: dict[str, Variable] = {}
        if made.verification is not None:
            made.verification.take(frame)
        if made.comparison is not None:
            more = made.comparison.take(next(originals), frame)
        made.take(frame)
        progress(f"replaying {len(chosen)} frames", done / len(chosen))
        yield frame, more


def first_bench(recording: Recording, chosen: range, change: Change | None = None) -> Bench:
    """The bench of the first of these frames that has one, as changed."""
    for index in chosen:
        number = recording.line(index).calibration
        if number is not None:
            calibration = recording.calibration(number)
            return (calibration if change is None else change(calibration)).bench
    return recording.bench

"""`svwfs replay`: reconstruct a recording again, to verify it or to compare another bench with its own."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from app.bench.bench_files import bench_file
from app.bench.config import Bench, load_bench, parse_bench, write_bench
from app.errors import InputError, RunError
from app.files import check_outputs, check_suffix
from app.measurement.calibration import Calibration
from app.progress import Progress, counted
from app.recording.folder import parts_of
from app.recording.reader import Recording
from app.recording.reprocess import Change, Reprocessed, reprocess
from app.results.assumed_layers import SampleTally
from app.results.dataset import results_in_pieces, write_pieces
from app.results.quality import QualityTally
from app.results.replay.comparison import Comparison, Verification
from app.results.view_quality import Variable
from reconstruction.errors import ReconstructionError
from reconstruction.runtime.threads import one_blas_thread


@dataclass(slots=True)
class Replay:
    """Outcome of a replay: a verification with the recorded bench, a comparison with another."""

    verification: Verification | None
    comparison: Comparison | None
    frames: int = 0
    reconstructed: int = 0
    unrefined: int = 0  # frames refined live but not in this replay
    problem: str = ""  # of the first frame that could not be reconstructed
    assumed: str = ""  # samples, in words
    samples: SampleTally = field(default_factory=SampleTally)
    quality: QualityTally = field(default_factory=QualityTally)

    def take(self, frame: Reprocessed) -> None:
        """Count one frame."""
        self.frames += 1
        self.reconstructed += frame.wavefront is not None
        self.unrefined += frame.wavefront is not None and frame.line.bias is not None and not frame.is_refined
        self.problem = self.problem or frame.problem
        if frame.wavefront is not None:
            self.quality.take(frame.quality)
            self.samples.take(frame.wavefront.sample)
            self.assumed = self.samples.sentence(frame.wavefront.field)


def replay(
    folder: Path,
    *,
    bench: str | None,
    settings: tuple[str, ...],
    frames: str | None,
    out: Path | None,
    overwrite: bool,
    verify: bool,
    progress: Progress,
) -> Replay:
    """Reconstruct the recorded frames FIRST:END again and write the results to `out`, if given.

    With another `bench`, or changed `settings` of the recorded one, both are made and compared. With `verify`, raise
    `RunError` if a result differs from the recorded one in any bit.
    """
    other = None if bench is None else load_bench(bench, settings)
    bench_read = () if bench is None or other is None else (bench_file(bench), *other.files)
    check_outputs([out], inputs=[*parts_of(folder), *bench_read], overwrite=overwrite)
    recording = Recording(folder)
    if other is None and settings:
        check_outputs([out], inputs=_changed(recording.bench, settings).files, overwrite=overwrite)
    check_suffix(out, ".nc")
    chosen = recording.select(frames)
    change = change_of(other, settings)
    if verify and change is not None:
        raise InputError("--verify compares with the recorded bench: leave --bench and --set out")
    made = Replay(Verification(recording) if change is None else None, None if change is None else Comparison())
    with one_blas_thread():
        stream = _frames(recording, chosen, change, made, progress)
        if out is not None:
            used, inputs = first_bench(recording, chosen, change), {"recording": recording.folder.name}
            write_pieces(out, results_in_pieces(stream), bench=used, inputs=inputs)
        for _ in stream:
            pass
    if verify and made.verification is not None and not made.verification.passes:
        raise RunError(f"{folder}: {made.verification.sentence}")
    return made


def _frames(
    recording: Recording, chosen: range, change: Change | None, made: Replay, progress: Progress
) -> Iterator[tuple[Reprocessed, Mapping[str, Variable]]]:
    """Reconstruct each frame, with both benches if there are two; yield it with additional variables."""
    originals = reprocess(recording, chosen)
    others = originals if change is None else reprocess(recording, chosen, change)
    for done, frame in enumerate(others, 1):
        more: dict[str, Variable] = {}
        if made.verification is not None:
            made.verification.take(frame)
        if made.comparison is not None:
            more = made.comparison.take(next(originals), frame)
        made.take(frame)
        progress(f"replaying {counted(len(chosen))}", done / len(chosen))
        yield frame, more


def change_of(bench: Bench | None, settings: tuple[str, ...]) -> Change | None:
    """Return the change of a recorded calibration to another bench, or to other settings; None if there is none."""
    if bench is None and not settings:
        return None

    def change(calibration: Calibration) -> Calibration:
        other = bench or _changed(calibration.bench, settings)
        try:
            return Calibration.of(other, calibration.dark, calibration.reference, calibration.full_scale)
        except ReconstructionError as error:
            raise InputError(f"the recorded reference does not fit this bench: {error}") from error

    return change


def _changed(recorded: Bench, settings: tuple[str, ...]) -> Bench:
    return parse_bench(write_bench(recorded), "the recorded bench", settings)


def first_bench(recording: Recording, chosen: range, change: Change | None = None) -> Bench:
    """Return the bench of the first chosen frame that has one, after the change."""
    for index in chosen:
        number = recording.line(index).calibration
        if number is not None:
            calibration = recording.calibration(number)
            return (calibration if change is None else change(calibration)).bench
    return recording.bench

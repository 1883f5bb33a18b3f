"""Another bench for what was recorded."""

from __future__ import annotations

from app.bench.config import load_bench, parse_bench, write_bench
from app.errors import InputError
from app.measurement.calibration import Calibration
from app.recording.reprocess import Change
from reconstruction.errors import ReconstructionError


def change_of(bench: str | None, settings: tuple[str, ...]) -> Change | None:
    """Return what turns a recorded calibration into one of another bench, or of its own with other settings.

    None when neither is wanted.
    """
    if bench is None and not settings:
        return None

    def change(calibration: Calibration) -> Calibration:
        if bench is None:
            other = parse_bench(write_bench(calibration.bench), "the recorded bench", settings)
        else:
            other = load_bench(bench, settings)
        try:
            return Calibration.of(other, calibration.dark, calibration.reference, calibration.full_scale)
        except ReconstructionError as error:
            raise InputError(f"the recorded reference does not go with this bench: {error}") from error

    return change

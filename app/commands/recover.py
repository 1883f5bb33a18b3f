"""`svwfs recover`: a recording cut short, completed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from app.commands import options, terminal
from app.errors import RunError

if TYPE_CHECKING:
    from app.recording.recover import Recovered


def recover(recording: options.RecordingFolder) -> None:
    """Complete a recording cut short by a crash, power failure or incomplete copy, and list its damage.

    Pixels are never changed. Everything happens in the recording's folder: each line of frames.jsonl is put in its
    place, run.json and the arrays are completed, and half-written files are removed. Lines that are taken out are saved
    as frames.damaged.jsonl. See `svwfs docs recording`.

    Example: svwfs recover run1
    """
    from app.recording.recover import recover as run

    with terminal.progress_bar() as progress:
        recovered = run(recording, lambda fraction: progress("checking the frames", fraction))
    print_recovered(recovered, recording)
    if not recovered.whole:
        raise RunError(f"{recording}: no frame is whole")
    if not recovered.has_calibration:
        raise RunError(f"{recording}: no frame can be reconstructed, because no calibration can be read")


def print_recovered(recovered: Recovered, folder: Path) -> None:
    """Print the state of a recording, what was repaired, and its damage."""
    state = "was complete" if recovered.was_complete else "is complete now"
    damaged = ", but damaged" if recovered.damage else ""
    terminal.print_sentence(f"{folder}: {state}{damaged}: {recovered.summary}")
    removed = ", ".join(map(str, recovered.removed))
    left = f"half written, and removed: {removed}" if removed else ""
    for sentence in (*recovered.damage, recovered.readable, recovered.put_aside, left):
        if sentence:
            terminal.print_sentence(f"{folder}: {sentence}")

"""Which frames of a recording are meant."""

from __future__ import annotations

from app.errors import InputError
from app.recording.reader import Recording


def chosen_frames(recording: Recording, text: str | None) -> range:
    """The frames FIRST:END, counted from 0, END not among them; either may be left out. All without a text."""
    if not len(recording):
        raise InputError(f"{recording.folder}: holds no frame")
    try:
        first, end = (int(part) if part.strip() else None for part in (text or ":").split(":"))
        frames = range(len(recording))[first:end]
    except ValueError as error:
        raise InputError(f"--frames {text}: write FIRST:END, counted from 0, for example 0:100") from error
    if not frames:
        raise InputError(f'--frames "{text}" means no frame; {recording.folder} has {len(recording)}')
    return frames

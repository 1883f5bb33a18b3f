"""Quality of frames: result variables, and sentences for the terminal and the report."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from app.results.view_quality import Variable, about
from reconstruction.quality.verdict import Fault, Quality


def quality_variable(quality: Quality) -> Variable:
    """Faults of a frame as CF flags, one bit each."""
    meanings = " ".join(fault.name.lower() for fault in Fault if fault.name)
    name = "faults that make the wavefront doubtful; 0 if none was found"
    masks = np.array([int(fault) for fault in Fault], np.int32)
    return (
        (),
        np.array(int(quality.faults), np.int32),
        {**about("1", name), "flag_masks": masks, "flag_meanings": meanings},
    )


@dataclass(slots=True)
class QualityTally:
    """Faults of several frames."""

    frames: int = 0
    _counts: Counter[Fault] = field(default_factory=Counter)
    _reasons: dict[Fault, str] = field(default_factory=dict)  # of the first frame with each
    unjudged: str = ""  # what could not be judged of some frames, and why

    def take(self, quality: Quality) -> None:
        """Add one frame."""
        self.frames += 1
        self._counts.update(quality.reasons.keys())
        self._reasons = {**quality.reasons, **self._reasons}
        self.unjudged = self.unjudged or quality.unjudged

    @property
    def sentences(self) -> list[str]:
        """One sentence for each fault, the most frequent first, with the number of frames if not all have it."""
        return [
            self._reasons[fault] if count == self.frames else f"{count} of {self.frames} frames: {self._reasons[fault]}"
            for fault, count in self._counts.most_common()
        ]

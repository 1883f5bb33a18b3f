"""Results in a recording's folder: `results.nc`, dark and reference."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np

from app.bench.config import Bench
from app.images import write_image
from app.progress import Progress
from app.recording.reader import Recording
from app.recording.reprocess import Reprocessed, reprocess
from app.results.assumed_layers import SampleTally
from app.results.dataset import results_in_pieces, write_pieces
from app.results.quality import QualityTally
from app.results.rotation import rotation_of
from app.results.uncertainty import rms_noise
from reconstruction.arrays import Floats
from reconstruction.registration.circulation import Circulation
from reconstruction.wavefront import rms

_RESULTS = "results.nc"


def files_of(folder: Path) -> list[Path]:
    """Return the files that `write_measured` writes."""
    return [folder / name for name in (_RESULTS, "dark.tif", "reference.tif")]


@dataclass(slots=True)
class Measured:
    """Statistics of all frames of a measurement."""

    bench: Bench
    mean_rms_rad: Floats  # mean over the frames, (view_row, view_column)
    square_rms_rad: Floats  # mean of the squares, rad^2, (view_row, view_column)
    square_noise_rad: Floats  # mean of the squares of each frame's noise, rad^2, (view_row, view_column)
    recorded: int = 0
    reconstructed: int = 0
    lost: int = 0  # by the camera
    exposure_s: float = np.nan  # of the last frame
    light_current_a: float | None = None  # of the last frame; None if unknown
    rotation: Circulation | None = None  # of the subimages of the last frame; None if the registration excludes it
    rotating: int = 0  # frames whose subimages rotate
    problem: str = ""  # of the first frame that could not be reconstructed
    mask_note: str = ""  # of the last frame, see `mask_sentence`
    samples: SampleTally = field(default_factory=SampleTally)
    quality: QualityTally = field(default_factory=QualityTally)

    @property
    def scatter_rms_rad(self) -> Floats:
        """Standard deviation of each view's RMS over the frames, rad, (view_row, view_column)."""
        return np.sqrt(np.maximum(self.square_rms_rad - self.mean_rms_rad**2, 0))

    @property
    def noise_rad(self) -> Floats:
        """Noise of one frame, rad, (view_row, view_column); see `rms_noise`."""
        return np.sqrt(self.square_noise_rad)

    @property
    def assumed(self) -> str:
        """Samples that were assumed, in words."""
        return self.samples.sentence(self.bench.field)

    def take(self, made: Reprocessed) -> None:
        """Add one frame."""
        self.recorded, self.lost = self.recorded + 1, self.lost + made.line.lost
        self.exposure_s, self.light_current_a = made.line.exposure_s, made.line.light_current_a
        if made.wavefront is None:
            self.problem = self.problem or made.problem
            return
        self.reconstructed += 1
        self.mask_note = made.mask_note
        self.quality.take(made.quality)
        self.samples.take(made.wavefront.sample)
        self.rotation = rotation_of(made.wavefront)
        self.rotating += self.rotation is not None and self.rotation.contradicts_layers
        values = rms(made.wavefront.views)
        self.mean_rms_rad = self.mean_rms_rad + (values - self.mean_rms_rad) / self.reconstructed
        self.square_rms_rad = self.square_rms_rad + (values**2 - self.square_rms_rad) / self.reconstructed
        noise = rms_noise(made.wavefront) ** 2
        self.square_noise_rad = self.square_noise_rad + (noise - self.square_noise_rad) / self.reconstructed


def write_measured(recording: Recording, bench: Bench, progress: Progress) -> Measured:
    """Write `results.nc`, `dark.tif` and `reference.tif` into a recording's folder.

    Every frame is reconstructed, also those that were skipped live; without any wavefront there is no `results.nc`.
    """
    shape = bench.field.view_rows, bench.field.view_columns
    measured = Measured(bench, *np.zeros((3, *shape)))
    _write_calibration(recording)
    pieces = results_in_pieces((made, {}) for made in _counted(recording, measured, progress))
    first = next(pieces, None)
    if first is not None:
        names = {"dark": "dark.tif", "reference": "reference.tif"}
        write_pieces(recording.folder / _RESULTS, chain([first], pieces), bench=bench, inputs=names)
    return measured


def _write_calibration(recording: Recording) -> None:
    """Write dark and reference of the first calibration as images."""
    if len(recording) and (number := recording.line(0).calibration) is not None:
        calibration = recording.calibration(number)
        for name, average in (("dark", calibration.dark), ("reference", calibration.reference)):
            if average is not None:
                write_image(recording.folder / f"{name}.tif", average.mean)


def _counted(recording: Recording, measured: Measured, progress: Progress) -> Iterator[Reprocessed]:
    """Reconstruct and count every frame."""
    for made in reprocess(recording):
        measured.take(made)
        progress("writing the results", (made.line.index + 1) / len(recording))
        yield made

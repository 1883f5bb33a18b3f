"""Quality, samples, rotation and noise of several frames, in words; results in a recording's folder."""

from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from app.bench.config import Bench
from app.files import MEASURED
from app.images import write_image
from app.measurement.measurement import Measurement, sample_sentence
from app.progress import Progress, counted, counting
from app.recording.reader import Recording
from app.recording.reprocess import Reprocessing
from app.results.dataset import results_in_pieces, rotation_of
from app.results.result_file import write_pieces
from reconstruction.arrays import Floats
from reconstruction.quality.verdict import Fault, Quality
from reconstruction.registration.circulation import Circulation
from reconstruction.wavefront import Wavefront, mean_known, mean_rms, rms

_RESULTS, _DARK, _REFERENCE = MEASURED
_WEAK_RAD = 0.1  # RMS from which on noise is not looked at: it takes some milliseconds
ROTATES = (
    "the subimages rotate, which thin layers cannot cause: look for a cylinder lens, different magnifications"
    " along x and y, or a camera turned since the reference; leave registration.rotation = true"
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


def rotation_sentence(found: Circulation) -> str:
    """Describe the rotation: "rotation of the subimages: -3.53 +- 0.81 mrad, 4.4 times its error; ..."."""
    if not found.is_shown:
        return "rotation of the subimages: not shown by this source with this warp"
    return (
        f"rotation of the subimages: {found.mean_rad * 1e3:+z.2f} +- {found.mean_sigma_rad * 1e3:.2f} mrad,"
        f" {abs(found.significance):.1f} times its error; chi-square of their circulation {found.chi_square:.1f}"
    )


def rms_over_lenslets(sigma: Floats) -> Floats:
    """RMS of values (view_row, view_column, lenslet_row, lenslet_column) over the lenslets; NaN where all are NaN."""
    return np.sqrt(mean_known(sigma**2))


def noise_above_rms(wavefront: Wavefront) -> float | None:
    """Return the noise of a single frame's wavefront, rad, if it hides the mean RMS, else None."""
    shown_rad = mean_rms(wavefront.views)
    if not shown_rad < _WEAK_RAD:
        return None
    noise_rad = float(np.sqrt(np.nanmean(rms_over_lenslets(wavefront.sigma()) ** 2)))
    return noise_rad if shown_rad < noise_rad else None


def rms_text(rms_rad: float, noise_rad: float) -> str:
    """Format an RMS, rad, as "0.123 +- 0.007"; without a number if it is below the noise."""
    if rms_rad < noise_rad:
        return f"below noise ({noise_rad:.3f} rad)"
    return f"{rms_rad:.3f} +- {noise_rad:.3f}" if np.isfinite(noise_rad) else f"{rms_rad:.3f}"


@dataclass(slots=True)
class FrameTally:
    """Counts of frames with their faults and samples."""

    frames: int = 0
    reconstructed: int = 0
    problem: str = ""  # of the first frame that could not be reconstructed
    quality: QualityTally = field(default_factory=QualityTally)
    _layers: Counter[int] = field(default_factory=Counter)  # frames, by number of assumed layers
    _newest: dict[int, str] = field(default_factory=dict)  # the last sample with each number, in words

    def count(self, made: Measurement) -> None:
        """Add one frame."""
        self.frames += 1
        self.problem = self.problem or made.problem
        if (wavefront := made.wavefront) is not None:
            self.reconstructed += 1
            self.quality.take(made.quality)
            layers = len(wavefront.sample.ratios)
            self._layers[layers] += 1
            self._newest[layers] = sample_sentence(wavefront.sample, wavefront.field)

    @property
    def assumed(self) -> str:
        """Assumed samples in words, with the newest distances, and of how many frames if not alike of all."""
        sentences = []
        for layers, count in self._layers.most_common():
            text, last = self._newest[layers], "last of " * bool(layers and count > 1)
            sentences.append(text if len(self._layers) == 1 and not last else f"{text} ({last}{counted(count)})")
        return "; ".join(sentences)


@dataclass(slots=True, kw_only=True)
class Measured(FrameTally):
    """Statistics of all frames of a measurement."""

    bench: Bench
    means: Floats  # over the frames: RMS, its square, and square of the noise, rad, (3, view_row, view_column)
    lost: int = 0  # by the camera
    exposure_s: float = np.nan  # of the last frame
    light_current_a: float | None = None  # of the last frame; None if unknown
    rotation: Circulation | None = None  # of the subimages of the last frame; None if the registration excludes it
    rotating: int = 0  # frames whose subimages rotate
    mask_note: str = ""  # of the last frame, see `mask_sentence`

    @property
    def scatter_rms_rad(self) -> Floats:
        """Standard deviation of each view's RMS over the frames, rad, (view_row, view_column); NaN for one frame."""
        variance = np.maximum(self.means[1] - self.means[0] ** 2, 0)
        unbiased = self.reconstructed / (self.reconstructed - 1) if self.reconstructed > 1 else np.nan
        return np.asarray(np.sqrt(unbiased * variance))

    @property
    def noise_rad(self) -> Floats:
        """Noise of one frame, rad, (view_row, view_column); a wavefront with a smaller RMS may be flat."""
        return np.asarray(np.sqrt(self.means[2]))

    def take(self, made: Measurement, mask_note: str) -> Measurement:
        """Add one frame, and return it."""
        self.count(made)
        self.lost, self.exposure_s = self.lost + made.lost, made.frame.exposure_s
        self.light_current_a = None if made.light is None else made.light.current_a
        if made.wavefront is not None:
            self.mask_note, self.rotation = mask_note, rotation_of(made.wavefront)
            self.rotating += self.rotation is not None and self.rotation.contradicts_layers
            values = rms(made.wavefront.views)
            numbers = np.stack([values, values**2, rms_over_lenslets(made.wavefront.sigma()) ** 2])
            self.means = self.means + (numbers - self.means) / self.reconstructed
        return made


def write_measured(recording: Recording, bench: Bench, progress: Progress) -> Measured:
    """Write `results.nc` of all frames, `dark.tif` and `reference.tif` into a recording's folder."""
    shape = bench.field.view_rows, bench.field.view_columns
    measured = Measured(bench=bench, means=np.zeros((3, *shape)))
    if len(recording) and (number := recording.line(0).calibration) is not None:
        calibration = recording.calibration(number)
        for name, average in ((_DARK, calibration.dark), (_REFERENCE, calibration.reference)):
            if average is not None:
                write_image(recording.folder / name, average.mean)
        found = calibration.bench
        bench = replace(bench, lattice=found.lattice, sensor=found.sensor)  # devices as they were in force
    reprocessing = Reprocessing(recording)
    frames = counting(reprocessing(), len(recording), progress, "writing the results")
    pieces = results_in_pieces((measured.take(made, reprocessing.mask_sentence(made)), {}) for made in frames)
    if (first := next(pieces, None)) is not None:
        names = {"dark": _DARK, "reference": _REFERENCE}
        write_pieces(recording.folder / _RESULTS, chain([first], pieces), bench=bench, inputs=names)
    return measured

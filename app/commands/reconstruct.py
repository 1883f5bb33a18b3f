"""`svwfs reconstruct`: the wavefront of a frame in image files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.errors import InputError
from app.files import read_image
from app.measurement.bench_reconstructor import BenchReconstructor, full_scale_of
from app.progress import Progress
from reconstruction.errors import ReconstructionError
from reconstruction.quality.verdict import Quality
from reconstruction.wavefront import Wavefront

_PEAK_PERCENT = 99.9  # percentile taken for the peak, so that hot pixels do not count


@dataclass(frozen=True, slots=True)
class Reconstructed:
    """Wavefront of a frame, and the steps of its refinement."""

    wavefront: Wavefront
    bench: Bench  # with the lattice in force
    changes_rad: tuple[float, ...]  # RMS change by each round of refinement, mean over the views
    quality: Quality


def reconstruct_files(
    frame: Path, *, reference: Path, dark: Path | None, bench: Bench, refine: int, progress: Progress
) -> Reconstructed:
    """Reconstruct one frame from image files, refined in at most `refine` rounds; `InputError` names a bad file."""
    frame_image, reference_image = read_image(frame), read_image(reference)
    dark_image = None if dark is None else read_image(dark)
    for path, image in ((frame, frame_image), (dark, dark_image)):
        if image is not None and image.shape != reference_image.shape:
            raise InputError(
                f"{path}: has {_size(image)} pixels (rows x columns), but the reference {reference} has"
                f" {_size(reference_image)}"
            )
    paths = {"frame": frame, "reference": reference, "dark": dark}
    try:
        most = min(full_scale_of(image, bench.camera_model.bits) for image in (reference_image, frame_image))
        if np.percentile(reference_image, _PEAK_PERCENT, method="lower") > full_scale_of(frame_image, 64):
            raise InputError(
                f"{frame}: holds {frame_image.dtype} values, which cannot be as large as those of the reference"
                f" {reference}: save both in the same form"
            )
        reconstructor = BenchReconstructor(bench, reference_image, dark=dark_image, full_scale=most, frame=frame_image)
        wavefront = reconstructor(frame_image)
        changes_rad = []
        if refine:
            progress("modelling the bench", 0.0)
            for done, step in enumerate(reconstructor.rounds(frame_image, refine), 1):
                wavefront = step.wavefront
                changes_rad.append(step.change_rad)
                progress("refining", done / refine)
        quality = reconstructor.quality(frame_image, wavefront)
        return Reconstructed(wavefront, reconstructor.bench, tuple(changes_rad), quality)
    except ReconstructionError as error:
        raise InputError(f"{paths.get(error.image) or reference}: {error}") from error


def _size(image: NDArray[Any]) -> str:
    return " x ".join(str(length) for length in image.shape)

"""`svwfs reconstruct`: the wavefront of a frame in image files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.bench.device_settings import CameraSettings
from app.errors import InputError
from app.images import read_image
from app.measurement.bench_reconstructor import BenchReconstructor, full_scale_of
from app.progress import Progress
from reconstruction.errors import ReconstructionError
from reconstruction.quality.verdict import Quality
from reconstruction.wavefront import Wavefront
from simulated_devices.settings import SimulatedCameraSettings

_PEAK_PERCENT = 99.9  # percentile taken for the peak, so that hot pixels do not count


@dataclass(frozen=True, slots=True)
class Reconstructed:
    """Wavefront of a frame, and the steps of its refinement."""

    wavefront: Wavefront
    bench: Bench  # with the lattice in force
    changes_rad: tuple[float, ...]  # RMS change by each round of refinement, mean over the views
    quality: Quality
    notes: tuple[str, ...]  # on what the mask shows, and on a frame whose size is not that of the bench


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
        _check_scale(frame_image, frame, reference_image, reference, bench.camera_model.bits)
        _check_scale(reference_image, reference, frame_image, frame, bench.camera_model.bits)
        reconstructor = BenchReconstructor(bench, reference_image, dark=dark_image)
        wavefront = reconstructor(frame_image)
        changes_rad = []
        if refine:
            progress("modelling the bench", 0.0)
            for done, step in enumerate(reconstructor.rounds(frame_image, refine), 1):
                wavefront = step.wavefront
                changes_rad.append(step.change_rad)
                progress("refining", done / refine)
        quality = reconstructor.quality(frame_image, wavefront)
        notes = filter(None, (reconstructor.mask_sentence(wavefront), _size_note(bench.camera, frame_image)))
        return Reconstructed(wavefront, reconstructor.bench, tuple(changes_rad), quality, tuple(notes))
    except ReconstructionError as error:
        raise InputError(f"{paths.get(error.image) or reference}: {error}") from error


def _check_scale(image: NDArray[Any], path: Path, other: NDArray[Any], other_path: Path, bits: int) -> None:
    """Raise `InputError` if another image has larger counts than this one's type, or the camera, allows it."""
    most = full_scale_of(image, 64 if image.dtype.kind in "ui" else bits)
    if np.percentile(other, _PEAK_PERCENT, method="lower") > most:
        raise InputError(
            f"{path}: holds {image.dtype} values up to {image.max():g}, but {other_path} {other.dtype} values up to"
            f" {other.max():g}: save both in the same form"
        )


def _size_note(camera: CameraSettings, frame: NDArray[Any]) -> str:
    """Say if a frame has another size than the bench's simulated camera, unless that has the size it has by default."""
    usual = SimulatedCameraSettings()
    size = (camera.rows, camera.columns) if isinstance(camera, SimulatedCameraSettings) else frame.shape
    if size in {frame.shape, (usual.rows, usual.columns)}:
        return ""
    return f"the frame has {_size(frame)} pixels, the bench's camera {size[0]} x {size[1]}: is this its bench?"


def _size(image: NDArray[Any]) -> str:
    return " x ".join(str(length) for length in image.shape)

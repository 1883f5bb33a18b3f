"""Frames of the simulated bench as arrays: dark, reference and frames with their true wavefronts."""

from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.acquisition.start_up import FRAMES
from app.bench.config import Bench, as_bench
from app.errors import InputError
from app.evaluation.noise_free import NoiseFreeFrames
from app.measurement.bench_reconstructor import whole_number
from reconstruction.arrays import Counts, Floats, Image
from simulated_devices.detector import Detector, Exposure


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFrames:
    """Images of a simulated bench, in counts, or in mean photons where noise-free."""

    reference: Image  # mean of 20 frames without the sample, (row, column)
    dark: Image  # mean of 20 frames without light, (row, column)
    frames: Counts  # with the sample, (frame, row, column)
    truth: Floats
    """True wavefront, rad, (view_row, view_column, lenslet_row, lenslet_column); with a leading frame axis where the
    sample moves."""


def simulate(bench: Bench, frames: int = 1, *, noise_free: bool = False) -> SimulatedFrames:
    """Simulate the images that the camera of a bench takes, with the true wavefronts.

    Parameters
    ----------
    bench
        The bench; its `[simulation]`, `[camera]` and `[light]` describe source, screen and detector.
    frames
        Number of frames with the sample. A drifting sample moves on by one of its states with every frame, so by
        `state_duration_s` of its drift.
    noise_free
        Return mean photons instead of counts; the dark is then zero.

    Returns
    -------
    SimulatedFrames
        `.reference` and `.dark` (row, column), `.frames` (frame, row, column), and `.truth` in rad (view_row,
        view_column, lenslet_row, lenslet_column), with a leading frame axis if the sample moves.

    Raises
    ------
    InputError
        If the bench cannot be rendered, or `frames` exceeds the states of a drifting sample.

    Examples
    --------
    >>> images = svwfs.simulate(bench, frames=2)
    >>> images.frames.shape, images.truth.shape
    ((2, 240, 256), (3, 3, 7, 7))
    """
    bench = as_bench(bench)
    frames = whole_number(frames, "frames")
    is_moving = bench.simulation.screen.is_drifting
    most = bench.simulation.drifting_states if is_moving else 10_000
    if not 1 <= frames <= most:
        raise InputError(f"{frames} frames cannot be simulated: 1 ... {most} are possible with this bench")
    camera, mask = bench.camera_model, bench.simulation.source.mask
    rendered = NoiseFreeFrames(bench)
    states = [rendered.frame(mask, state) for state in range(frames if is_moving else 1)]
    exposure_s = np.float32(camera.exposure_s)
    light = [state.photons * exposure_s for state in states] * (1 if is_moving else frames)
    reference = rendered.reference(mask) * exposure_s
    truth = np.stack([state.truth for state in states]) if is_moving else states[0].truth
    if noise_free:
        return SimulatedFrames(reference, np.zeros_like(reference), np.stack(light), truth)
    settings = Exposure(
        index=0,
        exposure_s=camera.exposure_s,
        amplifier=camera.amplifier,
        em_gain=camera.em_gain,
        readout_speed=camera.readout_speed if camera.amplifier == "em" else 1,
    )
    with closing(Detector(camera, seed=bench.simulation.seed)) as detector:

        def counts(photons: Image, index: int) -> NDArray[np.uint16]:
            return detector.counts(photons, replace(settings, index=index))

        def mean(photons: Image, first: int) -> Image:
            total = sum(counts(photons, first + index).astype(np.float64) for index in range(FRAMES))
            return np.asarray(total / FRAMES, np.float32)

        return SimulatedFrames(
            reference=mean(reference, FRAMES),
            dark=mean(np.zeros_like(reference), 0),
            frames=np.stack([counts(photons, 2 * FRAMES + index) for index, photons in enumerate(light)]),
            truth=truth,
        )

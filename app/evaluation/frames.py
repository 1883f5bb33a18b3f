"""Frames of the simulated bench with their true wavefronts: noise-free ones, and its camera's."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.acquisition.devices import scene_of
from app.bench.config import Bench, as_bench
from app.cache import Arrays, cached
from app.errors import InputError
from app.measurement.averages import FRAMES
from app.measurement.offline_reconstructor import whole_number
from reconstruction.arrays import Counts, Floats, Image
from simulated_devices.bench import PHOTONS_PER_S_M2_A
from simulated_devices.detector import Detector, FrameConditions
from simulated_devices.rendering import Renderer, Scene
from simulated_devices.sample import Sample
from simulated_devices.settings import Screen, SimulatedCameraSettings


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFreeFrame:
    """A frame with the sample, and its true wavefronts."""

    photons: Image  # mean number per pixel and second, (row, column)
    truth: Floats  # wavefronts, rad, (view_row, view_column, lenslet_row, lenslet_column)


class NoiseFreeFrames:
    """The frames of one bench, rendered on demand, by default with its mask."""

    def __init__(self, bench: Bench) -> None:
        self._scene = scene_of(bench)
        self.renderer = Renderer(self._scene)
        self._light = np.float32(PHOTONS_PER_S_M2_A * bench.light_model.current_a)

    def reference(self, mask: str = "") -> Image:
        """Mean photons per pixel and second without the sample, (row, column)."""
        mask = mask or self._scene.simulation.source.mask
        # The reference does not depend on the screen.
        empty = replace(self._scene, simulation=replace(self._scene.simulation, seed=0, screen=Screen()))
        rendered = self._cached(empty, f"{mask}-reference", lambda: {"photons": self.renderer.reference(mask)})
        return rendered["photons"]

    def frame(self, mask: str = "", state: int = 0) -> NoiseFreeFrame:
        """Return the frame with the sample in a state."""
        mask = mask or self._scene.simulation.source.mask
        kept = self._cached(
            self._scene,
            f"{mask}-{state}",
            lambda: {"photons": self.renderer.state(mask, state), "truth": self.renderer.truth_wavefront(state)},
        )
        return NoiseFreeFrame(kept["photons"], kept["truth"])

    @property
    def sample(self) -> Sample:
        """The phase screen in the beam."""
        try:
            return self.renderer.sample
        except ValueError as error:
            raise InputError(f"simulation: {error}") from error

    def _cached(self, scene: Scene, name: str, render: Callable[[], Arrays]) -> Arrays:
        def lit() -> Arrays:
            images = dict(render())
            images["photons"] = images["photons"] * self._light
            return images

        try:
            return cached("noise_free", f"{scene.fingerprint()}-{self._light:.6g}-{name}", lit)
        except ValueError as error:  # incompatible settings, or the file of the screen
            raise InputError(f"simulation: {error}") from error


def simulating(bench: Bench, **changes: Any) -> Bench:
    """Return the bench with changes of its simulation."""
    return replace(bench, simulation=replace(bench.simulation, **changes))


def with_screen(bench: Bench, **changes: Any) -> Bench:
    """Return the bench with a changed screen."""
    return simulating(bench, screen=replace(bench.simulation.screen, **changes))


def with_source(bench: Bench, **changes: Any) -> Bench:
    """Return the bench with a changed source."""
    return simulating(bench, source=replace(bench.simulation.source, **changes))


def seeded(bench: Bench, seeds: range, first: int | None = None) -> list[Bench]:
    """Return the bench with seeds of its screen, counted from its own seed or from `first`."""
    start = bench.simulation.seed if first is None else first
    return [simulating(bench, seed=start + index) for index in seeds]


def exposure_of(camera: SimulatedCameraSettings, index: int) -> FrameConditions:
    """Return the settings of a camera for one frame; the normal amplifier has one read-out speed."""
    return FrameConditions(
        index=index,
        exposure_s=camera.exposure_s,
        amplifier=camera.amplifier,
        em_gain=camera.em_gain,
        readout_speed=camera.readout_speed if camera.amplifier == "em" else 1,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFrames:
    """Images of a simulated bench, in counts, or in mean photons where noise-free."""

    reference: Image  # mean of `FRAMES` frames without the sample, (row, column)
    dark: Image  # mean of `FRAMES` frames without light, (row, column)
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
    camera = bench.camera_model
    rendered = NoiseFreeFrames(bench)
    states = [rendered.frame(state=state) for state in range(frames if is_moving else 1)]
    exposure_s = np.float32(camera.exposure_s)
    light = [state.photons * exposure_s for state in states] * (1 if is_moving else frames)
    reference = rendered.reference() * exposure_s
    truth = np.stack([state.truth for state in states]) if is_moving else states[0].truth
    if noise_free:
        return SimulatedFrames(reference, np.zeros_like(reference), np.stack(light), truth)
    detector = Detector(camera, seed=bench.simulation.seed)

    def counts(photons: Image, index: int) -> NDArray[np.uint16]:
        return detector.counts(photons, exposure_of(camera, index))

    def mean(photons: Image, first: int) -> Image:
        total = sum(counts(photons, first + index).astype(np.float64) for index in range(FRAMES))
        return np.asarray(total / FRAMES, np.float32)

    return SimulatedFrames(
        reference=mean(reference, FRAMES),
        dark=mean(np.zeros_like(reference), 0),
        frames=np.stack([counts(photons, 2 * FRAMES + index) for index, photons in enumerate(light)]),
        truth=truth,
    )

"""Noise-free frames of the simulated bench with their truth, cached on disk."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from app.acquisition.devices import scene_of
from app.bench.config import Bench
from app.cache import Arrays, cached
from app.errors import InputError
from reconstruction.arrays import Floats, Image
from simulated_devices.bench import PHOTONS_PER_S_M2_A
from simulated_devices.rendering import Renderer, Scene
from simulated_devices.sample import Sample
from simulated_devices.settings import Screen


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFreeFrame:
    """A frame with the sample, and its true wavefronts."""

    photons: Image  # mean number per pixel and second, (row, column)
    truth: Floats  # wavefronts, rad, (view_row, view_column, lenslet_row, lenslet_column)


class NoiseFreeFrames:
    """The frames of one bench, rendered on demand."""

    def __init__(self, bench: Bench) -> None:
        self._scene = scene_of(bench)
        self.renderer = Renderer(self._scene)
        self._light = np.float32(PHOTONS_PER_S_M2_A * bench.light_model.current_a)

    def reference(self, mask: str) -> Image:
        """Mean photons per pixel and second without the sample, (row, column)."""
        # The reference does not depend on the screen.
        empty = replace(self._scene, simulation=replace(self._scene.simulation, seed=0, screen=Screen()))
        rendered = self._cached(empty, f"{mask}-reference", lambda: {"photons": self.renderer.reference(mask)})
        return rendered["photons"]

    def frame(self, mask: str, state: int = 0) -> NoiseFreeFrame:
        """Return the frame with the sample in a state."""
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


def seeded(bench: Bench, seeds: range, first: int | None = None) -> list[Bench]:
    """Return the bench with seeds of its screen, counted from its own seed or from `first`."""
    start = bench.simulation.seed if first is None else first
    return [replace(bench, simulation=replace(bench.simulation, seed=start + index)) for index in seeds]

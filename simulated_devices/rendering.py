"""Rendered images of the bench, the reference and every state of the sample, and their cache on disk.

The name of an image contains a hash of everything it depends on. Files are written atomically; a damaged one counts
as missing. Images are rendered ahead in a child process, so that the live program never waits for it; the processes
share only these files.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, PointField, reading_npy
from reconstruction.geometry import Field, Lattice, Sensor
from reconstruction.runtime.background import BackgroundProcess
from reconstruction.runtime.renaming import rename
from reconstruction.runtime.threads import THREADS
from simulated_devices.optics.forward_model import ForwardModel, OnFraction
from simulated_devices.optics.source import SourcePoints, source_points
from simulated_devices.sample import Sample, make_sample, shift_m
from simulated_devices.settings import Simulation

_FORMAT = 4  # 4: light propagates from the screen to the lenslets, and rays cross as behind a collimator
_FOLDERS_KEPT = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Everything that an image depends on, except the light."""

    sensor: Sensor
    lattice: Lattice
    field: Field
    simulation: Simulation
    rows: int
    columns: int
    pixel_fill_factor: float
    lines: tuple[tuple[float, float], ...] = ()  # wavelength (m) and share of the light; none: the sensor's wavelength

    @property
    def states(self) -> int:
        """Number of positions of the screen."""
        return self.simulation.drifting_states if self.simulation.screen.is_drifting else 1

    def fingerprint(self) -> str:
        """SHA-256 of all parameters, of the files of screen and mask, and of the format."""
        parameters = {"format": _FORMAT, **asdict(self)}
        del parameters["simulation"]["source"]["mask"]  # the initial mask changes no image
        if not self.lines:
            del parameters["lines"]  # images of earlier versions stay good
        digest = hashlib.sha256(json.dumps(parameters, sort_keys=True).encode())
        for file in self.simulation.files:
            try:
                digest.update(hashlib.sha256(file.read_bytes()).digest())
            except OSError as error:
                raise ValueError(f"file = {str(file)!r} cannot be read: {error.strerror or error}") from error
        return digest.hexdigest()


class Renderer:
    """Renders one scene; prepares optics and screen when first needed.

    `phase_scale` multiplies the phase of the screen.
    """

    def __init__(self, scene: Scene, *, phase_scale: float = 1.0, threads: int = THREADS) -> None:
        self.scene = scene
        self._phase_scale, self._threads = phase_scale, threads

    @cached_property
    def lines(self) -> tuple[tuple[float, Renderer], ...]:
        """Share of the light, and renderer, of each line of the spectrum: their images add up.

        The screen delays all of them by the same path, so that its phase goes with the wavenumber.
        """
        scene, nominal_m = self.scene, self.scene.sensor.wavelength_m

        def line(wavelength_m: float) -> Renderer:
            alone = replace(scene, lines=(), sensor=replace(scene.sensor, wavelength_m=wavelength_m))
            return Renderer(alone, phase_scale=nominal_m / wavelength_m, threads=self._threads)

        return tuple((share, line(wavelength_m)) for wavelength_m, share in scene.lines) or ((1.0, self),)

    @cached_property
    def sample(self) -> Sample:
        """The phase screen in this scene, at the sensor's wavelength."""
        scene = self.scene
        return make_sample(scene.simulation, scene.sensor, scene.field, phase_scale=self._phase_scale)

    @cached_property
    def model(self) -> ForwardModel:
        """The optics at the sensor's wavelength."""
        scene = self.scene
        return ForwardModel(
            scene.sensor,
            scene.lattice,
            scene.field,
            shape=(scene.rows, scene.columns),
            pupil_samples=scene.simulation.pupil_samples,
            border_lenslets=scene.simulation.border_lenslets,
            pixel_fill_factor=scene.pixel_fill_factor,
            threads=self._threads,
        )

    def points(self, mask: str) -> SourcePoints:
        """Object points of a mask."""
        simulation = self.scene.simulation
        return source_points(mask, simulation.source, object_samples=simulation.object_samples)

    def reference(self, mask: str, progress: OnFraction | None = None) -> NDArray[np.float32]:
        """Irradiance (row, column), m^2, without the sample."""
        return self._sum(mask, None, progress)

    def state(self, mask: str, state: int, progress: OnFraction | None = None) -> NDArray[np.float32]:
        """Irradiance (row, column), m^2, with the sample in state number `state`."""
        return self._sum(mask, state, progress)

    def _sum(self, mask: str, state: int | None, progress: OnFraction | None) -> NDArray[np.float32]:
        """Add up the images of all lines; without the sample if `state` is None."""

        def part(first: int) -> OnFraction | None:
            return progress and (lambda done: progress((first + done) / len(self.lines)))

        image = np.zeros((), np.float32)
        for first, (share, line) in enumerate(self.lines):
            field = None if state is None else line.light(state)
            image = image + share * line.model.irradiance(line.points(mask), field, progress=part(first))
        return np.asarray(image, np.float32)

    def check_rays(self) -> None:
        """Raise `ValueError` if a ray of any state would leave the screen."""
        for state in (0, self.scene.states - 1):  # the ends of a straight drift reach farthest
            self.light(state)

    def truth_wavefront(self, state: int) -> Floats:
        """Wavefront of every view in that state: (view_row, view_column, lenslet_row, lenslet_column), rad.

        It is that of the sensor's wavelength, whatever the spectrum.
        """
        return self.sample.wavefront(shift_m(self.scene.simulation, state))

    def truth_intensity(self, state: int) -> Floats:
        """Light of every view at the lenslet centres relative to the reference, shaped like the wavefront."""
        return self.sample.intensity(shift_m(self.scene.simulation, state))

    def light(self, state: int) -> PointField:
        """Field of each object point with the sample in state number `state`."""
        shift = shift_m(self.scene.simulation, state)
        return self.sample.light_of_points(self.model.sample_x_m, self.model.sample_y_m, shift)


class ImageCache:
    """Images of one scene on disk, `folder / fingerprint / mask-state.npy`; empty if not writable."""

    def __init__(self, cache_folder: Path, scene: Scene) -> None:
        self._shape = scene.rows, scene.columns
        self._folder = cache_folder / scene.fingerprint()
        with suppress(OSError):  # not writable: nothing is cached; or another process deletes the old ones
            self._folder.mkdir(parents=True, exist_ok=True)
            os.utime(self._folder)  # the least recently used is deleted first
            scenes = (path for path in cache_folder.iterdir() if len(path.name) == 64)
            for old in sorted(scenes, key=lambda each: -each.stat().st_mtime)[_FOLDERS_KEPT:]:
                shutil.rmtree(old, ignore_errors=True)

    def path(self, mask: str, state: int | str) -> Path:
        """Path of an image; `state` may be "reference"."""
        return self._folder / f"{mask}-{state}.npy"

    def load(self, mask: str, state: int | str) -> NDArray[np.float32] | None:
        """Return the image, or None if there is no complete one."""
        try:
            with reading_npy():
                image = np.load(self.path(mask, state), allow_pickle=False)
        except (OSError, ValueError, EOFError):  # missing or damaged: render it
            return None
        if not isinstance(image, np.ndarray) or image.dtype != np.float32 or image.shape != self._shape:
            return None
        return image

    def save(self, mask: str, state: int | str, image: NDArray[np.float32]) -> None:
        """Write the image (row, column) atomically; `OSError` if the folder is read-only or full."""
        path = self.path(mask, state)
        part = path.with_name(f"{path.stem}-{uuid.uuid4().hex}.part")
        try:
            with part.open("wb") as file:
                np.save(file, image)
            rename(part, path)
        finally:
            with suppress(OSError):
                part.unlink()  # remains after an error


def rendering_ahead(scene: Scene, mask: str, cache_folder: Path) -> BackgroundProcess:
    """Start a child process that renders the states of one mask that the cache lacks."""
    process = BackgroundProcess(render_missing)
    process.send((scene, mask, cache_folder))
    return process


def render_missing(messages: Iterator[Any], _answer: Callable[[object], None] = lambda _: None) -> None:
    """Entry point of the process of `rendering_ahead`; stop if the cache cannot be written."""
    scene, mask, cache_folder = next(messages)
    cache, renderer = ImageCache(cache_folder, scene), Renderer(scene, threads=1)
    for state in range(scene.states):
        if cache.load(mask, state) is None:
            try:
                cache.save(mask, state, renderer.state(mask, state))
            except OSError:  # the others would be rendered in vain
                return

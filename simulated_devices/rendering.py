"""Images of the bench: of the reference and of every state of the sample, kept in a cache on disk.

An image is named by everything it depends on, so that it can be kept for ever. It appears under its name only when it
is complete; a file that is not a complete image is treated as if it were not there.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Lattice, Sensor
from simulated_devices.optics.forward_model import ForwardModel, PointPhase
from simulated_devices.optics.ray_map import truth_wavefront
from simulated_devices.optics.source import SourcePoints, source_points
from simulated_devices.sample import Sample, make_sample, shift_m
from simulated_devices.settings import Simulation

_FORMAT = 3  # 3: an enlarged screen is the ensemble's own in its middle
_FOLDERS_KEPT = 12

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Everything that an image depends on, but the light."""

    sensor: Sensor
    lattice: Lattice
    field: Field
    simulation: Simulation
    rows: int
    columns: int
    pixel_fill_factor: float

    @property
    def states(self) -> int:
        """How many positions of the screen there are."""
        return self.simulation.drifting_states if self.simulation.screen.is_drifting else 1

    def fingerprint(self) -> str:
        """SHA-256 of all parameters, of the screen's and the mask's file if there are any, and of the format."""
        parameters = {"format": _FORMAT, **dataclasses.asdict(self)}
        del parameters["simulation"]["source"]["mask"]  # which one is in at first changes none of the images
        digest = hashlib.sha256(json.dumps(parameters, sort_keys=True).encode())
        for file in (self.simulation.screen.file, self.simulation.source.file):
            if file:
                digest.update(hashlib.sha256(_content(Path(file))).digest())
        return digest.hexdigest()


class Renderer:
    """Renders one scene; the optics and the screen are prepared when first needed."""

    def __init__(self, scene: Scene, *, threads: int = 2) -> None:
        self.scene = scene
        self._threads = threads

    @cached_property
    def sample(self) -> Sample:
        """The phase screen in this scene."""
        return make_sample(self.scene.simulation, self.scene.sensor, self.scene.field)

    @cached_property
    def model(self) -> ForwardModel:
        """The optics."""
        scene = self.scene
        return ForwardModel(
            scene.sensor,
            scene.lattice,
            scene.field,
            rows=scene.rows,
            columns=scene.columns,
            pupil_samples=scene.simulation.pupil_samples,
            border_lenslets=scene.simulation.border_lenslets,
            pixel_fill_factor=scene.pixel_fill_factor,
            threads=self._threads,
        )

    def points(self, mask: str) -> SourcePoints:
        """Return the points of a mask."""
        simulation = self.scene.simulation
        return source_points(mask, simulation.source, object_samples=simulation.object_samples)

    def reference(self, mask: str, progress: Progress | None = None) -> NDArray[np.float32]:
        """Irradiance (row, column), m^2, without the sample."""
        return self.model.irradiance(self.points(mask), progress=progress)

    def state(self, mask: str, state: int, progress: Progress | None = None) -> NDArray[np.float32]:
        """Irradiance (row, column), m^2, with the sample in state number `state`."""
        return self.model.irradiance(self.points(mask), self.phase(state), progress=progress)

    def check_rays(self) -> None:
        """Raise `ValueError` if a ray of any state would leave the screen."""
        for state in (0, self.scene.states - 1):  # the drift is straight: the ends reach farthest
            self.phase(state)

    def truth_wavefront(self, state: int) -> Floats:
        """Wavefront of every view in that state: (view_row, view_column, lenslet_row, lenslet_column), rad."""
        scene, shift = self.scene, shift_m(self.scene.simulation, state)
        return truth_wavefront(self.sample.screen, self.sample.ray_map, scene.sensor, scene.field, shift)

    def phase(self, state: int) -> PointPhase:
        """Phase of each object point with the sample in state number `state`."""
        shift = shift_m(self.scene.simulation, state)
        return self.model.screen_phase(self.sample.screen, self.sample.ray_map, shift)


class ImageCache:
    """The images of one scene on disk: `folder / fingerprint / mask-state.npy`; where none can be kept, it is empty."""

    def __init__(self, cache_folder: Path, scene: Scene) -> None:
        self._shape = scene.rows, scene.columns
        self._folder = cache_folder / scene.fingerprint()
        with suppress(OSError):  # a folder that cannot be written keeps nothing, and that is all
            self._folder.mkdir(parents=True, exist_ok=True)
            os.utime(self._folder)  # used now: the last to be cleared away
            _keep_newest(cache_folder)

    def path(self, mask: str, state: int | str) -> Path:
        """Where an image is, or will be; `state` may be "reference"."""
        return self._folder / f"{mask}-{state}.npy"

    def load(self, mask: str, state: int | str) -> NDArray[np.float32] | None:
        """Return the image, or None if there is no complete one."""
        try:
            image = np.load(self.path(mask, state), allow_pickle=False)
        except (OSError, ValueError, EOFError):  # absent, truncated, or not an array: all cured by rendering
            return None
        if not isinstance(image, np.ndarray) or image.dtype != np.float32 or image.shape != self._shape:
            return None
        return image

    def save(self, mask: str, state: int | str, image: NDArray[np.float32]) -> bool:
        """Write the image, complete or not at all; return whether it is kept."""
        path = self.path(mask, state)
        part = path.with_name(f"{path.stem}-{uuid.uuid4().hex}.part")
        try:
            with part.open("wb") as file:
                np.save(file, image)
            part.replace(path)
        except OSError:  # read-only, or full
            return False
        finally:
            with suppress(OSError):
                part.unlink()  # of what came to nothing
        return True


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"file = {str(path)!r} cannot be read: {error.strerror or error}") from error


def _keep_newest(cache_folder: Path) -> None:
    """Clear away all but the scenes used last: a full disk is no use to anybody."""
    folders = sorted((path for path in cache_folder.iterdir() if len(path.name) == 64), key=_age)
    for folder in folders[_FOLDERS_KEPT:]:
        shutil.rmtree(folder, ignore_errors=True)


def _age(folder: Path) -> float:
    try:
        return -folder.stat().st_mtime
    except OSError:  # another process cleared it away
        return 0.0

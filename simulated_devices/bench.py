"""The simulated bench, on which three devices act: light, mask, sample and optics."""

from __future__ import annotations

import dataclasses
import math
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.interface import LightSource, Range, Stage
from reconstruction.runtime.background import BackgroundProcess
from simulated_devices.clock import Clock
from simulated_devices.detector import compile_ahead
from simulated_devices.optics.forward_model import OnFraction
from simulated_devices.rendering import ImageCache, Renderer, Scene, rendering_ahead
from simulated_devices.settings import SimulatedCameraSettings, SimulatedLightSettings


def played_state(time_s: float, *, states: int, rendered: int, duration_s: float) -> int:
    """State shown since 0 s: 0, 1, 2 ... to the last and back, of those that are rendered."""
    step = math.floor(time_s / duration_s) % max(2 * states - 2, 1)
    return min(step, 2 * states - 2 - step, rendered - 1)


PHOTONS_PER_S_M2_A = 1.2e15
"""Photons per second that one lenslet collects from one square metre of lit mask at one ampere.

Both exposures of the paper then come near 70 % of full scale at 0.35 A (EM amplifier, gain 1): the brightest pixels of
the reference reach 60 % with the square and 150 ms, 86 % with the 50 um pinholes and 3.8 s. A lenslet is seen under
6.25e-6 sr, so the radiance is 29 W/(m^2 sr) at 0.35 A: an LED behind a diffuser."""

_POLL_S = 0.2
_REFERENCE_SHARE = 0.25  # of the time to prepare


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """State of everything that the devices can change."""

    current_a: float
    mask: str
    is_light_on: bool = False
    is_sample_in: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReceivedLight:
    """Light that the camera received during an exposure."""

    parts: tuple[tuple[NDArray[np.float32], np.float32], ...]  # irradiances (row, column), m^2, and their doses, m^-2
    state: int | None  # of the sample at the end; None if it was out of the beam

    @property
    def light(self) -> tuple[NDArray[np.float32], np.float32]:
        """Image (row, column) and dose, whose product are the mean photons on each pixel."""
        if len(self.parts) == 1:
            return self.parts[0]
        return np.sum([image * dose for image, dose in self.parts], axis=0), np.float32(1)

    @property
    def photons(self) -> NDArray[np.float32]:
        """Mean number on each pixel, (row, column)."""
        image, dose = self.light
        return image * dose


class SimulatedBench:
    """A bench whose images are rendered once and then played.

    One thread uses it, but any may `change` the light. The constructor renders the reference and the first state,
    unless they are cached; `progress` receives 0 ... 1 over both. A child process renders the other states.
    """

    def __init__(
        self,
        scene: Scene,
        camera_settings: SimulatedCameraSettings,
        light_settings: SimulatedLightSettings,
        *,
        cache_folder: Path,
        clock: Clock | None = None,
        progress: OnFraction | None = None,
    ) -> None:
        self.camera_settings, self.light_settings = camera_settings, light_settings
        self.sensor, self.simulation = scene.sensor, scene.simulation
        self.clock = clock or Clock()
        self._scene = scene
        self._cache_folder = cache_folder
        self.renderer = Renderer(scene)
        self._cache = ImageCache(cache_folder, scene)
        self.references: dict[str, NDArray[np.float32]] = {}  # without the sample, by mask, (row, column), m^2
        self._films: dict[str, list[NDArray[np.float32]]] = {}
        self._ahead: BackgroundProcess | None = None
        self._start_s = self._next_poll_s = self.clock.now()
        self._changing = threading.Lock()
        condition = Condition(current_a=light_settings.current_a, mask=scene.simulation.source.mask)
        self._history: deque[tuple[float, Condition]] = deque([(self.clock.now(), condition)], maxlen=256)
        compile_ahead()
        self._prepare(condition.mask, progress)

    @property
    def condition(self) -> Condition:
        """The present condition."""
        return self._history[-1][1]

    @property
    def history(self) -> tuple[tuple[float, Condition], ...]:
        """The last conditions, each with the time from which it held."""
        with self._changing:
            return tuple(self._history)

    def change(self, **changes: float | bool | str) -> None:
        """Change fields of `condition` from now on."""
        mask = changes.get("mask", self.condition.mask)
        if mask != self.condition.mask:
            self._prepare(str(mask), None)
        with self._changing:
            condition = dataclasses.replace(self.condition, **changes)  # type: ignore[arg-type] # fields by name
            self._history.append((self.clock.now(), condition))

    def expose(self, start_s: float, end_s: float) -> ReceivedLight:
        """Photons on the camera from `start_s` to `end_s`; a change in between counts from its moment."""
        self._load_rendered()
        return self.expected(start_s, end_s)

    def expected(self, start_s: float, end_s: float) -> ReceivedLight:
        """As `expose`, with the images that are loaded, and of a time to come if nothing changes; for any thread."""
        parts, state = [], None
        for begin_s, finish_s, condition in self._pieces(start_s, end_s):
            image, state = self._image(condition, (begin_s + finish_s) / 2)
            current_a = condition.current_a if condition.is_light_on else 0.0
            lasting_s = round(max(finish_s - begin_s, 0.0), 9)  # the same for equal exposures
            parts.append((image, np.float32(PHOTONS_PER_S_M2_A * current_a * lasting_s)))
        return ReceivedLight(parts=tuple(parts), state=state)

    def close(self) -> None:
        """End the rendering ahead; closing twice is allowed."""
        if self._ahead is not None:
            self._ahead.close()
            self._ahead = None

    def _pieces(self, start_s: float, end_s: float) -> list[tuple[float, float, Condition]]:
        """Return the parts of the interval during which nothing changed, in order; at least one."""
        since_s, condition = self._history[-1]
        if since_s <= start_s:
            return [(start_s, end_s, condition)]
        history = self.history
        begins = [begin for begin, _ in history]
        ends = [*begins[1:], float("inf")]
        begins[0] = -float("inf")
        pieces = [
            (max(begin, start_s), min(end, end_s), condition)
            for begin, end, (_, condition) in zip(begins, ends, history, strict=True)
        ]
        return [piece for piece in pieces if piece[1] > piece[0]] or [(start_s, end_s, self.condition)]

    def _image(self, condition: Condition, time_s: float) -> tuple[NDArray[np.float32], int | None]:
        if not condition.is_sample_in:
            return self.references[condition.mask], None
        film, duration_s = self._films[condition.mask], self.simulation.state_duration_s
        since_s = time_s - self._start_s
        state = played_state(since_s, states=self._scene.states, rendered=len(film), duration_s=duration_s)
        return film[state], state

    def _prepare(self, mask: str, progress: OnFraction | None) -> None:
        """Render the reference and the first state of `mask`, and start to render its other states."""
        if mask not in self._films:
            first, reference = self._cache.load(mask, 0), self._cache.load(mask, "reference")
            if first is None:  # else they were checked before it was rendered
                self.renderer.check_rays()
            if reference is None:
                reference = self.renderer.reference(mask, _part(progress, 0.0, _REFERENCE_SHARE))
                with suppress(OSError):  # then the next start renders it again
                    self._cache.save(mask, "reference", reference)
            if first is None:
                first = self.renderer.state(mask, 0, _part(progress, _REFERENCE_SHARE, 1.0))
                with suppress(OSError):
                    self._cache.save(mask, 0, first)
            self.references[mask], self._films[mask] = reference, [first]
            self._load_states(mask, self._scene.states)
        if progress is not None:
            progress(1.0)
        self.close()
        if len(self._films[mask]) < self._scene.states:
            self._ahead = rendering_ahead(self._scene, mask, self._cache_folder)

    def _load_rendered(self) -> None:
        mask = self.condition.mask
        if len(self._films[mask]) < self._scene.states and self.clock.now() >= self._next_poll_s:
            self._next_poll_s = self.clock.now() + _POLL_S
            self._load_states(mask, 2)  # few at a time: frames must not wait

    def _load_states(self, mask: str, at_most: int) -> None:
        film = self._films[mask]
        for state in range(len(film), min(len(film) + at_most, self._scene.states)):
            image = self._cache.load(mask, state)
            if image is None:
                break
            film.append(image)


def _part(progress: OnFraction | None, start: float, end: float) -> OnFraction | None:
    """Map the 0 ... 1 of one step to its part of the whole."""
    return progress and (lambda fraction: progress(start + fraction * (end - start)))


class SimulatedLight(LightSource):
    """An LED whose light is proportional to its current."""

    def __init__(self, bench: SimulatedBench, *, limit_a: float | None = None) -> None:
        super().__init__(limit_a=limit_a, sleep=bench.clock.sleep)
        self._bench, self._name = bench, "Simulated LED"
        self._begin()

    def _read_range(self) -> Range:
        return Range(0.0, self._bench.light_settings.maximum_current_a)

    def _read_current(self) -> float:
        return self._bench.condition.current_a

    def _set_current(self, current_a: float) -> float:
        self._bench.change(current_a=current_a)
        return current_a

    def _is_lit(self) -> bool:
        return self._bench.condition.is_light_on

    def _switch(self, *, on: bool) -> None:
        self._bench.change(is_light_on=on)

    def _close(self) -> None:
        """Change nothing."""


class SimulatedStage(Stage):
    """Moves at once; a mask that is put in for the first time takes the time to render its first image."""

    def __init__(self, bench: SimulatedBench) -> None:
        super().__init__()
        self._bench, self._name = bench, "Simulated stage"

    def _read_masks(self) -> tuple[str, ...]:
        return self._bench.simulation.source.masks

    def _read_mask(self) -> str:
        return self._bench.condition.mask

    def _set_mask(self, mask: str) -> None:
        self._bench.change(mask=mask)

    def _is_sample_in(self) -> bool:
        return self._bench.condition.is_sample_in

    def _set_sample_in(self, *, is_in: bool) -> None:
        self._bench.change(is_sample_in=is_in)

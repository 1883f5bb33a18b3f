"""Sweep over the source: shapes, and brightness that varies within it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.bench.config import Bench
from app.cache import cache_folder
from app.evaluation.cases import CaseResult
from app.evaluation.noise_free import NoiseFreeFrames, seeded
from app.evaluation.study.estimators import WarpEstimators
from app.evaluation.study_kinds import Sweep
from app.files import atomic_write
from app.progress import Progress
from simulated_devices.optics.source import source_points
from simulated_devices.settings import Mask, Source

_MASKS: tuple[Mask, ...] = ("square", "circle", "octagon", "ellipse", "peaks")
_CELLS = 6  # of the checkerboard, along a side


def _measure(bench: Bench, seeds: int, progress: Progress) -> Iterator[CaseResult]:
    source = bench.simulation.source
    sources: dict[str, Source] = {mask: replace(source, mask=mask) for mask in _MASKS}
    sources["checkerboard"] = replace(source, file=str(_checkerboard()), mask="image")
    for index, (name, each) in enumerate(sources.items()):
        with_source = replace(bench, simulation=replace(bench.simulation, source=each))
        views = _lit_views(with_source, each)
        estimators = WarpEstimators(with_source, NoiseFreeFrames(with_source).reference(each.mask))
        for done, screen in enumerate(seeded(with_source, seeds)):
            progress(name, (index + done / seeds) / len(sources))
            frame = NoiseFreeFrames(screen).frame(each.mask)
            yield from estimators.compare(frame.photons, frame.truth, name, views=views)


def _lit_views(bench: Bench, source: Source) -> NDArray[np.bool_]:
    """True for views within the opening, (view_row, view_column); all views of the checkerboard count."""
    field = bench.field
    if source.mask == "image":
        return np.ones((field.view_rows, field.view_columns), np.bool_)
    points = source_points(source.mask, source, object_samples=bench.simulation.object_samples)
    y_m, x_m = np.meshgrid(field.view_y_m, field.view_x_m, indexing="ij")
    view_m = np.stack([x_m, y_m], axis=-1)
    distance_m = np.linalg.norm(view_m[..., None, :] - points.position_m, axis=-1)
    return np.asarray(points.area_m2[np.argmin(distance_m, axis=-1)] > 0)


def _checkerboard() -> Path:
    """The image of a checkerboard, at a fixed path so that its frames are cached."""
    path = cache_folder() / "study" / "checkerboard.npy"
    row, column = np.indices((_CELLS, _CELLS))
    with atomic_write(path) as temporary:
        np.save(temporary, ((row + column) % 2).astype(np.float32))
    return path


SOURCE = Sweep(name="source", title="Source (views inside it)", axis="shape", measure=_measure)

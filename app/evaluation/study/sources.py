"""Sweep over the source: shapes, and brightness that varies within it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from app.bench.config import Bench
from app.errors import InputError
from app.evaluation.cases import CaseResult
from app.evaluation.noise_free import NoiseFreeFrames, seeded
from app.evaluation.study.estimators import WarpEstimators
from app.evaluation.study_kinds import Sweep
from app.progress import Progress
from simulated_devices.optics.source import source_points
from simulated_devices.settings import Mask

_MASKS: tuple[Mask, ...] = ("square", "checkerboard", "circle", "octagon", "ellipse", "peaks")
_BRIGHT = 0.1  # of the highest brightness; darker points are outside the source
_ROUNDING = 1e-9


def _measure(bench: Bench, seeds: range, progress: Progress) -> Iterator[CaseResult]:
    for index, mask in enumerate(_MASKS):
        with_mask = replace(
            bench, simulation=replace(bench.simulation, source=replace(bench.simulation.source, mask=mask))
        )
        views = lit_views(with_mask)
        estimators = WarpEstimators(with_mask, NoiseFreeFrames(with_mask).reference(mask))
        for done, screen in enumerate(seeded(with_mask, seeds)):
            progress(mask, (index + done / len(seeds)) / len(_MASKS))
            frame = NoiseFreeFrames(screen).frame(mask)
            yield from estimators.compare(frame.photons, frame.truth, mask, views=views)


def lit_views(bench: Bench) -> NDArray[np.bool_]:
    """True for views within the outline of the source, (view_row, view_column).

    The outline is the convex hull of the points with a tenth of the highest brightness.
    """
    simulation, field = bench.simulation, bench.field
    points = source_points(simulation.source.mask, simulation.source, object_samples=simulation.object_samples)
    bright = points.area_m2 > _BRIGHT * points.area_m2.max()
    try:
        outline = ConvexHull(points.position_m[bright]).equations  # outward normal and offset of each side
    except QhullError as error:
        raise InputError("the source is a point or a line: no view lies inside it") from error
    y_m, x_m = np.meshgrid(field.view_y_m, field.view_x_m, indexing="ij")
    distance_m = np.stack([x_m, y_m], axis=-1) @ outline[:, :2].T + outline[:, 2]
    return np.asarray(np.all(distance_m <= _ROUNDING * field.half_width_m, axis=-1))


SOURCE = Sweep(name="source", title="Source (views inside it)", axis="shape", measure=_measure)

"""What is found out about a wavefront beside the wavefront itself, for what the window shows and nothing else.

No widget: a question in, an analysis out; the `Analyst` has it answered on a thread of its own.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped] # ships no types

from app.bench.config import Bench
from reconstruction.arrays import Floats
from reconstruction.geometry import Sensor
from reconstruction.modes.pupil_modes import PupilModes, pupil_modes
from reconstruction.quality.image_quality import Mtf, mtf, psf, psf_angles_rad, psf_reach_rad
from reconstruction.quality.isoplanatism import Isoplanatism, isoplanatism
from reconstruction.quality.slope_fit import slope_fit
from reconstruction.settings import PupilBasis
from reconstruction.solve.modal import ModalSolution
from reconstruction.wavefront import Wavefront

_INTERVAL_S = 0.2  # between two analyses of a running measurement


class Quantity(StrEnum):
    """What the grid of views shows."""

    WAVEFRONT = "Wavefront"
    PSF = "PSF"
    MEASURED = "Measured"
    FITTED = "Fitted"
    DIFFERENCE = "Difference"
    UNCERTAINTY = "Uncertainty"


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked about a wavefront."""

    wavefront: Wavefront
    bench: Bench
    quantity: Quantity
    reach_rad: float | None  # how far point-spread functions are wanted; None is as far as there is light
    view: tuple[int, int] | None  # whose modulation transfer is asked for, and isoplanatism with it


@dataclass(frozen=True, slots=True, eq=False)
class Analysis:
    """The answer; what was not asked for is None."""

    question: Question
    maps: Floats | None = None  # of the quantity, rad or a ratio, (view_row, view_column, row, column)
    reach_rad: float = math.nan  # from the middle of a point-spread function's map to the middle of its last pixel
    light_reach_rad: float = math.nan  # how far there is light
    transfer: Mtf | None = None  # of the view
    isoplanatism: Isoplanatism | None = None


def analyse(question: Question) -> Analysis:
    """Find out what is asked."""
    analysis = _map(question)
    if question.view is None:
        return analysis
    return replace(
        analysis,
        transfer=mtf(question.wavefront.views[question.view], question.bench.sensor),
        isoplanatism=isoplanatism(question.wavefront),
    )


class Analyst:
    """Answers one question at a time in the background, a few times a second."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="analysis")
        self._libraries = ThreadpoolController()
        self._question: Question | None = None
        self._answer: Future[Analysis] | None = None
        self._asked_s = -math.inf

    def ask(self, question: Question) -> None:
        """Have a question answered, unless one is still being answered or the same was.

        Another wavefront waits its time, whatever else is new in a question has it answered at once.
        """
        if self._answer is not None or question == self._question:
            return
        is_new_wavefront_alone = (
            self._question is not None and replace(question, wavefront=self._question.wavefront) == self._question
        )
        if is_new_wavefront_alone and time.monotonic() < self._asked_s + _INTERVAL_S:
            return
        self._question, self._asked_s = question, time.monotonic()
        self._answer = self._executor.submit(self._analyse, question)

    def answer(self) -> Analysis | None:
        """Return the answer, once, when it is there; raise what went wrong in finding it."""
        if self._answer is None or not self._answer.done():
            return None
        answer, self._answer = self._answer, None
        return answer.result()

    def close(self) -> None:
        """Wait for the end of what is under way, some milliseconds, and end the thread."""
        self._executor.shutdown(cancel_futures=True)

    def _analyse(self, question: Question) -> Analysis:
        """Answer on one core: BLAS threads that wait for one another take five times as long beside a measurement."""
        with self._libraries.limit(limits=1, user_api="blas"):
            return analyse(question)


def _map(question: Question) -> Analysis:
    """The maps of the quantity; the wavefront's own are there without an analysis."""
    wavefront, sensor, quantity = question.wavefront, question.bench.sensor, question.quantity
    if quantity is Quantity.PSF:
        return _point_spread(question)
    if quantity is Quantity.UNCERTAINTY:
        return Analysis(question, wavefront.sigma())
    if quantity is Quantity.WAVEFRONT:
        return Analysis(question)
    settings, solution = question.bench.reconstruction, wavefront.solution
    count = len(solution.coefficients) if isinstance(solution, ModalSolution) else settings.pupil_modes
    compared = slope_fit(wavefront, sensor, _modes(sensor, settings.basis, count))
    maps = {
        Quantity.MEASURED: compared.measured,
        Quantity.FITTED: compared.fitted,
        Quantity.DIFFERENCE: compared.difference,
    }
    return Analysis(question, maps[quantity])


def _point_spread(question: Question) -> Analysis:
    views, sensor = question.wavefront.views, question.bench.sensor
    light_reach_rad = psf_reach_rad(views, sensor)
    reach_rad = light_reach_rad if question.reach_rad is None else question.reach_rad
    if not math.isfinite(reach_rad):
        return Analysis(question)
    maps = psf(views, sensor, angle_rad=psf_angles_rad(sensor, reach_rad))
    return Analysis(question, maps, reach_rad, light_reach_rad)


@lru_cache(maxsize=2)
def _modes(sensor: Sensor, basis: PupilBasis, count: int | None) -> PupilModes:
    return pupil_modes(sensor, basis, count)

"""The live path measured with a window and a recording, and then without either: `svwfs benchmark --live`."""

from __future__ import annotations

import time

from app.acquisition.streams.publisher import stream_sinks
from app.commands.display import use_display
from app.evaluation.benchmark.live.course import Course
from app.evaluation.benchmark.live.figures import LiveFigures
from app.evaluation.benchmark.live.plan import LivePlan, recording_folder
from app.progress import Progress, between, named

_LOOK_S = 0.1
_WARM_UP_S = 3.0  # of the run without a window: nothing of it is about memory


def live_benchmark(plan: LivePlan, progress: Progress) -> LiveFigures:
    """Measure; where there is no display the window is drawn unseen.

    Whatever ends it, Ctrl-C too, the light goes off and the recording is removed.
    """
    is_seen = use_display()
    warm_up_s = min(_WARM_UP_S, plan.warm_up_s)
    lasting_s = (plan.warm_up_s + plan.seconds, warm_up_s + plan.without_window_s)
    middle = lasting_s[0] / sum(lasting_s)
    in_window = named(between(progress, 0.0, middle), "window" if is_seen else "unseen window")
    with stream_sinks(plan.bench) as sinks:
        with recording_folder(plan, in_window) as folder:
            with_window = Course(
                plan.bench,
                in_window,
                warm_up_s=plan.warm_up_s,
                seconds=plan.seconds,
                memory_s=plan.memory_s,
                record_into=folder,
                sinks=sinks,
            )
            _run_in_window(with_window)
        without_window = Course(
            plan.bench,
            named(between(progress, middle, 1.0), "no window"),
            warm_up_s=warm_up_s,
            seconds=plan.without_window_s,
            sinks=sinks,
        )
        _run(without_window)
    return LiveFigures(
        plan=plan,
        is_seen=is_seen,
        window=with_window.span,
        recording=with_window.acquisition.recording,
        bare=without_window.span,
    )


def _run_in_window(course: Course) -> None:
    from app.gui.application import run_window

    run_window(lambda: course.acquisition, begin=lambda _: course.begin(), until=course.look)


def _run(course: Course) -> None:
    course.acquisition.start()
    try:
        course.begin()
        while not course.look():
            time.sleep(_LOOK_S)
    finally:
        course.acquisition.close()

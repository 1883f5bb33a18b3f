"""`svwfs benchmark --live`: frame rate and latency with window and recording, then without both."""

import time

from app.acquisition.streams.publisher import stream_sinks
from app.commands.display import use_display
from app.evaluation.benchmark.live_path.course import Course
from app.evaluation.benchmark.live_path.figures import LiveFigures
from app.evaluation.benchmark.live_path.plan import LivePlan, recording_folder
from app.progress import Progress, between, named

_POLL_S = 0.1
_WARM_UP_S = 3.0  # maximum, of the run without a window, which measures no memory


def benchmark_acquisition(plan: LivePlan, progress: Progress) -> LiveFigures:
    """Measure both runs; without a display the window is drawn offscreen.

    The light is turned off and the recording removed, also on an error or Ctrl-C.
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
            _run_in_window(with_window, with_panels=plan.with_panels)
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


def _run_in_window(course: Course, *, with_panels: bool) -> None:
    from app.gui.application import run_window
    from app.gui.main_window import MainWindow

    def open_course(window: MainWindow) -> None:
        if with_panels:
            tabs = window.tabs
            window.docks.float_panels(tabs.coefficients, tabs.history, tabs.histogram)
        window.open(lambda: course.acquisition, lambda _: course.begin())

    run_window(None, until=course.poll, open_first=open_course, remembers=False)


def _run(course: Course) -> None:
    course.acquisition.start()
    try:
        course.begin()
        while not course.poll():
            time.sleep(_POLL_S)
    finally:
        course.acquisition.close()

"""Times of one layer at a known distance: prepared once, and with the normal equations of every frame."""

from functools import partial

from app.evaluation.benchmark.stopwatch import medians_s, side_by_side
from app.evaluation.benchmark.timed_frames import TimedFrames
from reconstruction.settings import RegistrationSettings

RATIO = 0.975  # of field to pupil position: 195 mm from the lenslets of the paper's bench


def layer_times(frames: TimedFrames, budget_s: float) -> dict[str, float]:
    """Return seconds per frame from displacements to the layer with its error bars, and what the preparation saves."""
    reconstructor = frames.reconstructor(RegistrationSettings())
    displacement = reconstructor.register(frames.frame)
    times_s = medians_s(
        side_by_side(
            {
                "prepared": partial(reconstructor.layer, displacement, RATIO),
                "full": lambda: reconstructor.layers(displacement).fit(RATIO),
            },
            budget_s,
        )
    )
    return {f"{name}_s": seconds for name, seconds in times_s.items()} | {
        "ratio": times_s["full"] / times_s["prepared"]
    }

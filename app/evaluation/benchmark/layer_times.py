"""Times of one layer at a known distance, and of the search for the layers of a sample."""

from functools import partial

from app.evaluation.benchmark.stopwatch import medians_s, side_by_side
from app.evaluation.benchmark.timed_frames import TimedFrames
from reconstruction.settings import RegistrationSettings

_RATIO = -0.975  # of field to pupil position: 195 mm in front of the lenslets of the paper's bench


def layer_times(frames: TimedFrames, budget_s: float) -> dict[str, float]:
    """Return seconds from displacements to a layer at a known distance, and to layers at unknown ones."""
    reconstructor = frames.reconstructor(RegistrationSettings())
    displacement = reconstructor.register(frames.frame)
    times_s = medians_s(
        side_by_side(
            {
                "known": lambda: reconstructor.layers(displacement).fit(_RATIO),
                "search": partial(reconstructor.find_sample, displacement),
            },
            budget_s,
        )
    )
    return {f"{name}_s": seconds for name, seconds in times_s.items()}

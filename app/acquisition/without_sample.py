"""Routines of the guided calibration that take the sample out of the beam and move it back."""

from app.acquisition.instrument import Instrument
from app.measurement.auto_exposure import AutoExposure
from app.measurement.averages import take_reference
from app.measurement.routines import FrameProgress, ShouldStop, restored
from reconstruction.lattice.search import Survey

_FRAMES = 4  # averaged to find the lattice


def find_lattice(instrument: Instrument, *, progress: FrameProgress, should_stop: ShouldStop) -> Survey:
    """Find the lenslets in a few frames without changing anything; `ReconstructionError` if there are none."""
    return instrument.survey(take_reference(instrument.devices, _FRAMES, progress=progress, should_stop=should_stop))


def expose(instrument: Instrument, *, progress: FrameProgress, should_stop: ShouldStop) -> AutoExposure:
    """Find and set exposure and current for frames without the sample, of which the reference is made."""
    with restored(instrument.devices) as state:
        instrument.devices.stage.set_sample_in(False)
        found = instrument.auto_expose(progress=progress, should_stop=should_stop)
        state.exposure_s, state.current_a = found.exposure_s, found.current_a
        return found

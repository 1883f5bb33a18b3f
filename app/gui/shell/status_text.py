"""Texts about the state of the instrument, and whether the shown frame is live."""

import math
import time
from dataclasses import replace

from app.acquisition.instrument import Activity, Status
from app.gui.panels.panel import DataFreshness
from app.gui.widgets.presentation import percent
from app.measurement.auto_exposure import AutoExposure
from app.measurement.measurement import Gap, Measurement
from app.measurement.sensor_region import SensorArea, lenslets_outside, moved_lattice
from app.progress import counted
from app.recording.recorder import RecordingState
from app.results.dataset import rotation_of
from app.results.run_summary import ROTATES
from reconstruction.lattice.search import Survey
from reconstruction.quality.verdict import NO_FAULT, Quality
from reconstruction.wavefront import Wavefront

_SLOW_S = 1.0  # a frame shown for longer is explained
_STOPPED = "the camera is stopped: Space starts it"
_SATURATED = "saturated"  # in a problem of a frame
_OTHER = DataFreshness("ANOTHER SAMPLE? SEARCHING", "it contradicts the layers found last: any wavefront is allowed")


class AlarmTracker:
    """Alarms about the frames of the present conditions."""

    def __init__(self) -> None:
        self._conditions: tuple[object, ...] = ()  # of the frames
        self._changed_s = -math.inf  # time of their last change

    def alarm(self, status: Status | None, activity: Activity, measurement: Measurement | None) -> str:
        """Return why wavefronts are missing or doubtful; empty during an activity, and if all is well."""
        if status is None:
            return ""
        averages = (status.dark, status.reference)
        conditions = (status.bench, status.mask, status.is_sample_in, status.is_light_on, status.exposure_s, *averages)
        if conditions != self._conditions:  # earlier problems are over
            self._conditions, self._changed_s = conditions, time.perf_counter()
        if activity.text:
            return ""
        if measurement is None:
            return warning(status)
        if measurement.file or status.is_replay:  # the light shines on neither
            status = replace(status, is_light_on=True)
        elif measurement.exposure_end_s < self._changed_s:
            return warning(status)
        return warning(status, measurement.problem, measurement.wavefront, measurement.quality)


def data_freshness(
    status: Status | None, failure: str, activity: Activity, measurement: Measurement | None
) -> DataFreshness:
    """Return how the shown frame differs from a live one."""
    if status is None or measurement is None:
        waits = activity.text or failure
        return DataFreshness("WAITING" if waits else "", waits, is_grey=bool(waits))
    age_s = time.perf_counter() - measurement.exposure_end_s
    age = f"{age_s:.0f} s" if age_s < 100 else f"{age_s / 60:.0f} min"
    if measurement.file:
        return DataFreshness(f"FILE {measurement.file}", "Space returns to the camera")
    is_other = measurement.assumed.is_other
    if status.is_replay:
        return _OTHER if is_other else DataFreshness("REPLAY", status.camera_name)
    if failure:
        return DataFreshness(f"DISCONNECTED, {age} old", failure, is_grey=True)
    is_stopped = not status.is_running and not activity.text  # to study the frame: it keeps its colours
    if is_stopped or (_is_old(measurement) and age_s > 3 * measurement.latency_s):  # a slow method is always late
        why = _STOPPED if is_stopped else activity.text or "no newer frame has come yet"
        word = "PAUSED" if is_stopped else "BUSY" if activity.text else "LATE"
        return DataFreshness(f"{word}, {age} old", why, is_grey=not is_stopped)
    reason = "; ".join(each.doubt for each in (status.dark, status.reference) if each.validity == "doubtful")
    stale = DataFreshness("STALE" if reason else "", reason, is_grey=bool(reason))
    return _OTHER if is_other and not reason else stale


def warning(status: Status, problem: str = "", wavefront: Wavefront | None = None, quality: Quality = NO_FAULT) -> str:
    """Return why wavefronts are missing or doubtful and which keys help; empty if all is well.

    Without light, or with a reference for other frames, a `problem` of the newest frame is a consequence, unless it is
    saturated; else it comes first, then its `quality`; subimages of its `wavefront` that rotate come last.
    """
    if problem and not status.is_light_on:
        return "the light is off: switch it on (L)"
    if status.warning and _shows_few(status, status.area):
        return _cut_off(status, status.area)
    if problem not in {"", status.warning} and (status.reference.validity == "good" or _SATURATED in problem):
        return problem
    stale = (("D: dark", status.dark), ("R: reference", status.reference))
    keys = ", ".join(key for key, average in stale if average.validity != "good")
    own = "" if status.warning in quality.sentence else status.warning
    if quality.reasons and not keys:
        return "; ".join(filter(None, (quality.sentence, own)))
    if not status.warning and wavefront is not None and status.bench.registration.rotation:
        rotation = rotation_of(wavefront)
        return ROTATES if rotation is not None and rotation.contradicts_layers else ""
    return f"{status.warning}  ({keys})" if status.warning and keys else status.warning


def advice(status: Status | None, activity: Activity, measurement: Measurement | None) -> str:
    """Return the current activity or the next useful key."""
    if activity.text:
        return f"{activity.text}: Esc cancels" if status is not None and activity.may_cancel else activity.text
    if status is None:
        return "no bench is open: open one (Ctrl+O), or a preset in the menu Bench"
    if not status.is_running:
        return "the replay is paused: Space plays it" if status.is_replay else _STOPPED
    if measurement is not None and _is_old(measurement):
        is_slow = measurement.latency_s > _SLOW_S
        took = f": the method needs {measurement.latency_s:.0f} s for each" if is_slow else ""
        return f"no newer frame has come for {time.perf_counter() - measurement.exposure_end_s:.0f} s{took}"
    return status.mask_note or "F1 shows keys and conventions"


def _is_old(measurement: Measurement) -> bool:
    """True if a newer frame should have come by now."""
    return time.perf_counter() - measurement.exposure_end_s > _SLOW_S + 2 * measurement.frame.exposure_s


def way_out(status: Status | None, *, is_lost: bool) -> str:
    """Return what a failure has shut down, unless the instrument is lost, and what to do."""
    if is_lost:
        return "reconnect (Ctrl+R)"
    if status is None:
        return "no device is open: reconnect (Ctrl+R)"
    if status.is_replay:
        return "the replay has ended: open the recording again (Ctrl+Shift+O)"
    if status.bench.has_manual_light:
        return "the devices are shut down, switch the light off by hand: reconnect (Ctrl+R)"
    return "light and devices are shut down: reconnect (Ctrl+R)"


def left_behind(status: Status | None, waited_s: float) -> str:
    """Return what is known of the light if the window closed before its worker had ended."""
    hangs = f"a device or a computation did not end within {waited_s:g} s"
    if status is None or (status.is_light_on and not status.bench.has_manual_light):
        return f"{hangs}, so the light may still be on: switch it off by hand"
    return f"{hangs}; {light_when_closing(status)}"


def light_when_closing(status: Status) -> str:
    """Return what becomes of the light while the window closes."""
    if status.bench.has_manual_light:
        return "switch the light off by hand" if status.is_light_on else "you noted that the light is off"
    return "switching the light off" if status.is_light_on else "the light is off"


def lattice_found(survey: Survey) -> str:
    """Describe a proposed lattice."""
    lattice, lit = survey.lattice, survey.illuminated
    return (
        f"found: pitch {lattice.pitch_text(3)}, rotation {lattice.rotation_rad * 1e3:+z.2f} mrad,"
        f" centre {lattice.center_x_px:.2f}, {lattice.center_y_px:.2f} px;"
        f" {lit.sum()} of {lit.size} illuminated; fit error {survey.residual_px:.3f} px RMS"
    )


def exposure_found(found: AutoExposure) -> str:
    """Describe the result of the automatic exposure."""
    return (
        f"exposure {found.exposure_s * 1e3:.4g} ms, light {found.current_a * 1e3:.4g} mA:"
        f" {percent(found.fill)} of full scale, after {counted(found.frames)}"
    )


def area_taken(status: Status, area: SensorArea) -> tuple[str, bool]:
    """Describe the sensor area that the camera took, and return whether no lenslet is cut off."""
    if _shows_few(status, area):
        return _cut_off(status, area), False
    retake = "" if status.reference.validity == "good" else "; take a new dark (D) and reference (R)"
    outside = _outside(status, area)
    if outside:
        return f"{outside} of {_lenslets(status)} lenslets are cut off by {area}{retake}", False
    return f"the camera reads out {area}{retake}", True


def _lenslets(status: Status) -> int:
    return math.prod(status.bench.sensor.lenslets)


def _outside(status: Status, area: SensorArea) -> int:
    """Number of lenslets that this area cuts off, and not the edge of the camera's sensor."""
    if status.lattice is None:
        return 0
    sensor, whole = status.bench.sensor, SensorArea(status.capabilities.sensor or area.region, 1)
    beyond = lenslets_outside(moved_lattice(status.lattice, area, whole), sensor, whole)
    return lenslets_outside(status.lattice, sensor, area) - beyond * (status.capabilities.sensor is not None)


def _shows_few(status: Status, area: SensorArea) -> bool:
    """True if most lenslets lie outside a part of the sensor, so that no reference can be used."""
    if area.region == status.capabilities.sensor or status.capabilities.sensor is None or status.lattice is None:
        return False
    return _outside(status, area) > _lenslets(status) / 2


def _cut_off(status: Status, area: SensorArea) -> str:
    return f"{_outside(status, area)} of {_lenslets(status)} lenslets are outside the region of {area}: enlarge it (P)"


def recording_ended(state: RecordingState) -> str:
    """Describe a finished recording."""
    if state.stage == "ended early":
        return f"the recording ended early, {counted(state.frames)} saved: {state.problem}"
    causes = "; ".join(dict.fromkeys(gap.cause for gap in state.gaps))
    gaps = f", with {gaps_in_words(state.gaps)} ({causes})" if state.gaps else ""
    return f"recorded {counted(state.frames)} in {state.folder}{gaps}"


def gaps_in_words(gaps: tuple[Gap, ...]) -> str:
    """Return number and total time of the gaps of a recording."""
    return f"{counted(len(gaps), 'gap')} of {sum(gap.seconds for gap in gaps):.1f} s"


def as_sentence(text: str) -> str:
    """Begin a message with a capital, unless it begins with the name of a file."""
    first = text.partition(" ")[0].rstrip(":,;")
    return text if "." in first else text[:1].upper() + text[1:]

"""Commands of an instrument, the same in its process and in another."""

from collections.abc import Callable
from concurrent.futures import Future
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from app.acquisition.instrument import Instrument

P = ParamSpec("P")
T = TypeVar("T")


def _command(request: Callable[Concatenate[Instrument, P], T]) -> Callable[Concatenate["Commands", P], Future[T]]:
    """Return the method that sends a request of the instrument, which executes it between two frames."""

    @wraps(request)
    def send(to: "Commands", /, *arguments: P.args, **named: P.kwargs) -> Future[T]:
        future: Future[T] = to.commands.submit(request, *arguments, **named)
        return future

    return send


class Commands:
    """The commands. Any thread may send one; its future resolves after the status is updated."""

    commands: Any  # takes them: the queue of the worker, or what the connection sends

    set_running = _command(Instrument.set_running)
    set_exposure_s = _command(Instrument.set_exposure_s)
    set_em_gain = _command(Instrument.set_em_gain)
    set_amplifier = _command(Instrument.set_amplifier)
    set_readout_speed = _command(Instrument.set_readout_speed)
    set_current_a = _command(Instrument.set_current_a)
    set_light_on = _command(Instrument.set_light_on)
    set_sample_in = _command(Instrument.set_sample_in)
    set_area = _command(Instrument.set_area)
    take_dark = _command(Instrument.take_dark)
    take_reference = _command(Instrument.take_reference)
    use = _command(Instrument.use)
    auto_expose = _command(Instrument.auto_expose)
    check_background = _command(Instrument.check_background)
    find_lattice = _command(Instrument.find_lattice)
    survey_lattice = _command(Instrument.survey_lattice)
    measure_linearity = _command(Instrument.measure_linearity)
    change_settings = _command(Instrument.change_settings)
    undoable = _command(Instrument.undoable)
    undo = _command(Instrument.undo)
    start_recording = _command(Instrument.start_recording)
    keep_recent = _command(Instrument.keep_recent)

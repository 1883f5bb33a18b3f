"""The switch that turns the light off beside the thread that owns the devices."""

import threading
from collections.abc import Callable
from concurrent.futures import Future

from app.progress import run_in_thread
from drivers.interface import LightSource


class EmergencyLightOff:
    """Switches the light off on a thread of its own, and keeps it off against earlier commands.

    They cannot light it either if it went off on its own, as after a freeze. The worker calls `attach` and
    `begin_command`; any thread may call `known` and `switch_off`. A light serialises its calls, so that `switch_off`
    waits for one of them at most.
    """

    def __init__(self, hear_requests: Callable[[], object] = lambda: None) -> None:
        """`hear_requests` is called before the light may shine: a request of a client may have arrived unheard."""
        self._light: LightSource | None = None
        self._hear_requests = hear_requests
        self.requests = 0  # to switch off, so far
        self.served = 0  # requests that have been carried out
        self._known = (0, "")  # when the present command was sent
        self._threads: list[threading.Thread] = []

    def attach(self, light: LightSource) -> None:
        """Use this light from now on."""
        self._light = light
        light.may_shine = self._may_shine

    @property
    def is_light_silent(self) -> bool:
        """True if the light has not answered for some seconds."""
        return self._light is not None and self._light.is_silent

    def known(self) -> tuple[int, str]:
        """Number of requests so far, and why the light went off on its own, as a command is sent."""
        return self.requests, "" if self._light is None else self._light.off_reason

    def begin_command(self, known: tuple[int, str]) -> None:
        """Note what was known when the command was sent that begins now."""
        self._known = known

    def switch_off(self) -> Future[None]:
        """Switch the light off; the future resolves when it is off, or has the error of the light."""
        self.requests += 1
        future, thread = run_in_thread(self._switch_off, "light off")
        self._threads = [*(one for one in self._threads if one.is_alive()), thread]
        return future

    def close(self, timeout_s: float) -> None:
        """Wait for requests under way."""
        for thread in self._threads:
            thread.join(timeout_s)

    def _may_shine(self) -> bool:
        self._hear_requests()
        (requests, off_reason), (known_requests, known_reason) = self.known(), self._known
        return requests == known_requests and off_reason in ("", known_reason)

    def _switch_off(self) -> None:
        if self._light is not None:  # else no device is open yet, and `may_shine` keeps the light off
            self._light.set_on(False)
        self.served += 1

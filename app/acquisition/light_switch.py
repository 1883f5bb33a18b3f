"""Path to the light beside the command queue: it switches the light off at once, whatever the worker does."""

import threading
from concurrent.futures import Future

from drivers.interface import LightSource


class LightSwitch:
    """Switches the light off on a thread of its own, and keeps it off against commands that were sent before.

    The worker calls `attach` and `begin_command`; any thread may call `switch_off`. A light serialises its calls, so
    that `switch_off` waits for one of them at most.
    """

    def __init__(self) -> None:
        self._light: LightSource | None = None
        self.requests = 0  # to switch off, so far
        self.served = 0  # requests that have been carried out
        self._known = 0  # requests that were made before the present command was sent
        self._threads: list[threading.Thread] = []

    def attach(self, light: LightSource) -> None:
        """Use this light from now on."""
        self._light = light
        light.may_shine = lambda: self._known == self.requests

    def begin_command(self, known: int) -> None:
        """Note how many requests had been made when the command was sent that begins now."""
        self._known = known

    def switch_off(self) -> "Future[None]":
        """Switch the light off; the future resolves when it is off, or has the error of the light."""
        self.requests += 1
        future: Future[None] = Future()
        thread = threading.Thread(target=self._switch_off, args=(future,), name="light off", daemon=True)
        self._threads = [*(one for one in self._threads if one.is_alive()), thread]
        thread.start()
        return future

    def close(self, timeout_s: float) -> None:
        """Wait for requests under way."""
        for thread in self._threads:
            thread.join(timeout_s)

    def _switch_off(self, future: "Future[None]") -> None:
        try:
            if self._light is not None:  # else no device is open yet, and `may_shine` keeps the light off
                self._light.set_on(False)
        except BaseException as error:  # noqa: BLE001 - the future passes it on
            future.set_exception(error)
        else:
            self.served += 1
            future.set_result(None)

"""Settings of a bench that belong to the application: played recordings and published results."""

import ipaddress
from dataclasses import dataclass
from typing import Literal

from reconstruction.geometry import require

Pace = Literal["own", "fastest"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSettings:
    """A recording in place of the devices."""

    driver: Literal["recording"] = "recording"
    folder: str
    pace: Pace = "own"  # as recorded; "fastest": each frame when it is read, so that none is skipped
    repeat: bool = False  # start again after the last frame; otherwise no more frames come


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings:
    """Port for other programs; without one nothing is published and no socket opened.

    `address` is this computer's on the network to be served; by default only this computer can connect.
    """

    port: int | None = None
    address: str = "127.0.0.1"  # 0.0.0.0: every network

    def __post_init__(self) -> None:
        require(
            {
                "port must be 1 ... 65535": self.port is None or 1 <= self.port <= 65535,
                "address must be an IPv4 address of this computer, as 127.0.0.1": _is_address(self.address),
            }
        )


def _is_address(text: str) -> bool:
    try:
        ipaddress.IPv4Address(text)
    except ValueError:
        return False
    return True

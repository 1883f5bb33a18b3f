"""Where live results are published for other programs: the section `[streams]` of a bench."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from reconstruction.geometry import require


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings:
    """The port that other programs connect to; without one nothing is published, and no socket is open.

    `address` is that of this computer on the network to be served. Left out, only this computer hears anything.
    """

    port: int | None = None
    address: str = "127.0.0.1"  # 0.0.0.0 is every network

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

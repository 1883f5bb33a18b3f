"""Section `[streams]` of a bench: publication of live results."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from reconstruction.geometry import require


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings:
    """Port that other programs connect to; without one nothing is published and no socket opened.

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

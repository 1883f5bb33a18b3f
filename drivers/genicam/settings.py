"""What a bench's TOML says to a GenICam camera: `[camera]` with driver "genicam"."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from drivers.frame import Region
from drivers.genicam.frames import PIXEL_FORMATS


@dataclass(frozen=True, slots=True, kw_only=True)
class GenicamSettings:
    """How a GigE Vision or USB3 Vision camera is found and set; what is left out is left to the camera."""

    driver: Literal["genicam"] = "genicam"
    device: str = ""  # its name as `svwfs devices` shows it, serial number or address; "" takes the only one there is
    pixel_pitch_m: float | None = None  # of the sensor; only where the camera does not tell it itself
    pixel_format: str = ""  # for example "Mono12"; "" takes the deepest
    exposure_s: float | None = None
    gain: float | None = None  # the analogue gain in the camera's own unit, mostly dB: no electron multiplication
    frame_rate_hz: float | None = None  # as fast as exposure and read-out allow
    binning: int = 1
    region: Region | None = None  # the whole sensor
    trigger: str = "internal"  # or the camera's name for a source, for example "Line0"
    buffers: int = 32  # frames that may wait for the program before the next is lost
    packet_size: int | None = None  # bytes, GigE: the largest that gets through; 8000 wants jumbo frames all the way
    socket_buffer_bytes: int = 2**24  # GigE: the system may grant less (net.core.rmem_max), and packets are then lost
    packet_socket: bool = False  # GigE: a faster way past the system's network stack, which needs root

    def __post_init__(self) -> None:
        positive = {
            "pixel_pitch_m": self.pixel_pitch_m,
            "exposure_s": self.exposure_s,
            "frame_rate_hz": self.frame_rate_hz,
        }
        conditions = {
            f"{key} must be positive": value is None or 0 < value < math.inf for key, value in positive.items()
        } | {
            f"pixel_format must be one of {', '.join(PIXEL_FORMATS)}": self.pixel_format in {"", *PIXEL_FORMATS},
            "gain must be finite": self.gain is None or math.isfinite(self.gain),
            "binning must be 1 ... 64": 1 <= self.binning <= 64,
            "buffers must be 2 ... 10000": 2 <= self.buffers <= 10000,
            "packet_size must be 576 ... 65535": self.packet_size is None or 576 <= self.packet_size <= 65535,
            "socket_buffer_bytes must be 2**16 ... 2**30": 2**16 <= self.socket_buffer_bytes <= 2**30,
        }
        for sentence, holds in conditions.items():
            if not holds:
                raise ValueError(sentence)

"""Bench settings of a GenICam camera: `[camera]` with driver "genicam"."""

import math
from dataclasses import dataclass
from typing import Literal

from drivers.frame import Region
from drivers.genicam.pixel_formats import PIXEL_FORMATS


@dataclass(frozen=True, slots=True, kw_only=True)
class GenicamSettings:
    """Selection and settings of a GigE Vision or USB3 Vision camera; what is omitted keeps the camera's value."""

    driver: Literal["genicam"] = "genicam"
    device: str = ""  # name in `svwfs devices`, serial number or address; "" takes the only one
    pixel_pitch_m: float | None = None  # of the sensor, if the camera does not report it
    pixel_format: str = ""  # for example "Mono12"; "" takes the deepest without padding
    full_scale: int | None = None  # count at which a pixel saturates; None: found from the camera and its frames
    byte_order: Literal["", "little", "big"] = ""  # of 16-bit pixels; "" takes that of the model
    exposure_s: float | None = None
    gain: float | None = None  # analogue gain in the camera's unit, mostly dB; no electron multiplication
    frame_rate_hz: float | None = None  # None: as fast as exposure and readout allow
    binning: int = 1
    region: Region | None = None  # the whole sensor
    trigger: str = "internal"  # or one of the camera's sources, for example "Line0"
    buffers: int = 32  # buffered frames before the next is lost
    packet_size: int | None = None  # bytes, GigE; None: the largest that gets through; 8000 needs jumbo frames
    socket_buffer_bytes: int = 2**24  # GigE; the system may grant less (net.core.rmem_max), and lose packets
    packet_socket: bool = False  # GigE: faster, past the system's network stack; needs root

    def __post_init__(self) -> None:
        positive = ("pixel_pitch_m", "exposure_s", "frame_rate_hz")
        conditions = {
            f"{key} must be positive": (value := getattr(self, key)) is None or 0 < value < math.inf for key in positive
        } | {
            f"pixel_format must be one of {', '.join(PIXEL_FORMATS)}": self.pixel_format in {"", *PIXEL_FORMATS},
            "full_scale must be 1 ... 65535": self.full_scale is None or 1 <= self.full_scale <= 65535,
            'byte_order must be "", "little" or "big"': self.byte_order in {"", "little", "big"},
            "gain must be finite": self.gain is None or math.isfinite(self.gain),
            "binning must be 1 ... 64": 1 <= self.binning <= 64,
            "buffers must be 2 ... 10000": 2 <= self.buffers <= 10000,
            "packet_size must be 576 ... 65535": self.packet_size is None or 576 <= self.packet_size <= 65535,
            "socket_buffer_bytes must be 2**16 ... 2**30": 2**16 <= self.socket_buffer_bytes <= 2**30,
        }
        for sentence, holds in conditions.items():
            if not holds:
                raise ValueError(sentence)

"""Settings of the real devices, as a bench file gives them."""

import math
import re
from dataclasses import dataclass, field
from typing import Literal

from drivers.frame import Region
from drivers.genicam.frames import PIXEL_FORMATS


@dataclass(frozen=True, slots=True, kw_only=True)
class DcamSettings:
    """Selection and settings of a DCAM camera; what is omitted keeps the camera's value.

    Opening the camera checks what depends on its mode: exposure, EM gain, binning, region.
    """

    driver: Literal["dcam"] = "dcam"
    device: str = ""  # serial number, or "0" for the first; "" takes the only one
    library: str = ""  # path of dcamapi.dll or libdcamapi.so if not installed in the standard place
    pixel_pitch_m: float | None = None  # of the sensor, if the camera does not report it
    amplifier: Literal["normal", "em"] | None = None
    readout_speed: int | None = None  # from 1, the slowest; limits the exposure; the normal amplifier has only 1
    exposure_s: float | None = None
    em_gain: float | None = None
    em_gain_protection: bool = True  # black frames instead of too much light, which ages the EM register
    em_gain_protection_frames: int | None = None  # with too much light, before it acts
    em_gain_warning_level: int | None = None  # 1 ... 3, the most sensitive
    binning: int = 1
    region: Region | None = None  # the whole sensor
    trigger: Literal["internal", "external", "software"] = "internal"
    trigger_active: Literal["edge", "level", "synchronous"] | None = None
    trigger_polarity: Literal["negative", "positive"] | None = None
    trigger_delay_s: float | None = None
    output: Literal["low", "exposure", "programmable", "trigger ready", "high"] | None = None  # of the first connector
    output_polarity: Literal["negative", "positive"] | None = None
    cooler: Literal["off", "on", "max"] | None = None
    ring_frames: int = 128  # buffered before the oldest is overwritten

    def __post_init__(self) -> None:
        delay_s, level, frames = self.trigger_delay_s, self.em_gain_warning_level, self.em_gain_protection_frames
        conditions = {
            f"{key} must be positive": value is None or 0 < value < math.inf
            for key, value in (("pixel_pitch_m", self.pixel_pitch_m), ("exposure_s", self.exposure_s))
        } | {
            "readout_speed must be at least 1": self.readout_speed is None or self.readout_speed >= 1,
            "em_gain must be 0 or positive": self.em_gain is None or 0 <= self.em_gain < math.inf,
            'em_gain needs amplifier = "em"': self.em_gain is None or self.em_gain == 1 or self.amplifier != "normal",
            "em_gain_protection_frames must be 1 ... 255": frames is None or 1 <= frames <= 255,
            "em_gain_warning_level must be 1, 2 or 3": level is None or 1 <= level <= 3,
            "binning must be 1 ... 16": 1 <= self.binning <= 16,
            "trigger_delay_s must be 0 or positive": delay_s is None or 0 <= delay_s < math.inf,
            "ring_frames must be 4 ... 10000": 4 <= self.ring_frames <= 10000,
        }
        for sentence, holds in conditions.items():
            if not holds:
                raise ValueError(sentence)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class MicroManagerSettings:
    """Selection and settings of a camera; what is omitted keeps the camera's value.

    Opening the camera checks what depends on it: exposure, binning, region, properties.
    """

    driver: Literal["micro_manager"] = "micro_manager"
    adapter: str  # for example "AndorSDK3"
    device: str  # name of the camera in the adapter, for example "Andor sCMOS Camera"
    adapter_folder: str = ""  # where Micro-Manager is installed
    properties: dict[str, str] = field(default_factory=dict)  # set at open, by the adapter's names
    pixel_pitch_m: float | None = None  # of the sensor; Micro-Manager does not know it
    full_scale: int | None = None  # count at which a pixel saturates, if not 2**bits - 1
    exposure_s: float | None = None
    binning: int = 1
    region: Region | None = None  # the whole sensor
    ring_frames: int = 64  # buffered before the oldest are overwritten

    def __post_init__(self) -> None:
        conditions = {
            f"{key} must be positive": value is None or 0 < value < math.inf
            for key, value in (("pixel_pitch_m", self.pixel_pitch_m), ("exposure_s", self.exposure_s))
        } | {
            "adapter and device must be named": bool(self.adapter and self.device),
            # with a slash, a library anywhere on the disk would be loaded
            "adapter must be a name of letters, digits, '_', '.' and '-'": re.fullmatch(
                r"[A-Za-z0-9_.-]+", self.adapter
            ),
            "full_scale must be 1 ... 65535": self.full_scale is None or 1 <= self.full_scale <= 65535,
            "binning must be 1 ... 64": 1 <= self.binning <= 64,
            "ring_frames must be 4 ... 10000": 4 <= self.ring_frames <= 10000,
        }
        for sentence, holds in conditions.items():
            if not holds:
                raise ValueError(sentence)


@dataclass(frozen=True, slots=True, kw_only=True)
class CoolLEDSettings:
    """Selection and settings of a CoolLED pE-300, pE-340fura or pE-4000."""

    driver: Literal["coolled"] = "coolled"
    port: str = ""  # such as /dev/ttyACM0 or COM3
    serial_number: str = ""  # of its USB adapter, instead of the port
    channel: str = "A"  # A ... C of a pE-300, A ... D of a pE-4000, E ... H of its expansion box
    full_current_a: float = 1.0  # nominal current at 100 %
    wavelength_nm: int | None = None  # to load into the channel; A ... D of a pE-4000 only
    current_a: float | None = None  # None keeps its value
    limit_a: float | None = None  # owner's limit, below that of the head

    def __post_init__(self) -> None:
        check_address(self.port, self.serial_number)
        if self.channel not in set("ABCDEFGH"):
            raise ValueError("channel must be a letter from A to H")
        if not 0 < self.full_current_a <= 100:
            raise ValueError("full_current_a must be positive, and at most 100")
        if self.wavelength_nm is not None and not 300 <= self.wavelength_nm <= 1000:
            raise ValueError("wavelength_nm must be 300 ... 1000")
        if self.wavelength_nm is not None and self.channel in set("EFGH"):
            raise ValueError(
                "wavelength_nm can be loaded into channels A to D only: leave it out for the expansion box"
            )
        if self.limit_a is not None and not 0 < self.limit_a <= 100:
            raise ValueError("limit_a must be positive, and at most 100")


@dataclass(frozen=True, slots=True, kw_only=True)
class DC4100Settings:
    """Selection and settings of a Thorlabs DC4100 or DC4104."""

    driver: Literal["thorlabs_dc4100"] = "thorlabs_dc4100"
    port: str = ""  # such as /dev/ttyUSB0 or COM3
    serial_number: str = ""  # of its USB adapter, instead of the port
    channel: int = 0  # 0 ... 3 are LED1 ... LED4
    current_a: float | None = None  # None keeps its value
    limit_a: float | None = None  # owner's limit, below that of the head

    def __post_init__(self) -> None:
        check_address(self.port, self.serial_number)
        if self.channel not in range(4):
            raise ValueError("channel must be 0 ... 3, for LED1 ... LED4")
        if self.limit_a is not None and not 0 < self.limit_a <= 10:
            raise ValueError("limit_a must be positive, and at most 10")


def check_address(port: str, serial_number: str) -> None:
    """Raise `ValueError` unless exactly one of the two is given."""
    if bool(port) == bool(serial_number):
        raise ValueError("port must be given, or serial_number of the USB adapter, and not both")


@dataclass(frozen=True, slots=True, kw_only=True)
class DC2200Settings:
    """Selection and settings of a Thorlabs DC2200."""

    driver: Literal["thorlabs_dc2200"] = "thorlabs_dc2200"
    serial_number: str = ""  # needed if there is more than one
    terminal: int = 1  # 1 has 12 pins and up to 10 A, 2 has 4 pins and up to 2 A
    gate: Literal["internal", "ttl"] = "internal"
    current_a: float | None = None  # None keeps its value
    limit_a: float | None = None  # owner's limit, below that of the head

    def __post_init__(self) -> None:
        if self.terminal not in {1, 2}:
            raise ValueError("terminal must be 1 or 2")
        if self.gate not in {"internal", "ttl"}:
            raise ValueError('gate must be "internal" or "ttl"')
        if self.limit_a is not None and not 0 < self.limit_a <= 10:
            raise ValueError("limit_a must be positive, and at most 10")

"""Bench settings of LED light sources on a serial port."""

from dataclasses import dataclass
from typing import Literal


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

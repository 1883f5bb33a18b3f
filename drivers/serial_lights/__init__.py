"""LED light sources on serial ports: their settings."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le
from typing_extensions import Doc

from drivers.light_source import KEPT_CURRENT, OWNERS_LIMIT


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialLightSettings:
    """Settings of every light on a serial port."""

    driver: str
    port: Annotated[str, Doc("Serial port, for example /dev/ttyUSB0, /dev/ttyACM0 or COM3")] = ""
    serial_number: Annotated[str, Doc("Serial number of the USB adapter, instead of the port")] = ""
    current_a: Annotated[float, Ge(0), Le(100), KEPT_CURRENT] | None = None

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if bool(self.port) == bool(self.serial_number):
            yield "port", "must be given, or serial_number of the USB adapter, and not both"


@dataclass(frozen=True, slots=True, kw_only=True)
class CoolLEDSettings(SerialLightSettings):
    """Selection and settings of a CoolLED pE-300, pE-340fura or pE-4000."""

    driver: Literal["coolled"] = "coolled"
    channel: Annotated[
        Literal["A", "B", "C", "D", "E", "F", "G", "H"],
        Doc("Channel: A ... C of a pE-300, A ... D of a pE-4000, E ... H of its expansion box"),
    ] = "A"
    full_current_a: Annotated[float, Gt(0), Le(100), Doc("Nominal current at 100 %")] = 1.0
    wavelength_nm: Annotated[int, Ge(300), Le(1000), Doc("Wavelength to load, pE-4000, A ... D")] | None = None
    limit_a: Annotated[float, Gt(0), Le(100), OWNERS_LIMIT] | None = None

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        yield from SerialLightSettings.faults(self)
        if self.wavelength_nm is not None and self.channel in "EFGH":
            yield "wavelength_nm", "can be loaded into channels A to D only: leave it out for the expansion box"


@dataclass(frozen=True, slots=True, kw_only=True)
class DC4100Settings(SerialLightSettings):
    """Selection and settings of a Thorlabs DC4100 or DC4104."""

    driver: Literal["thorlabs_dc4100"] = "thorlabs_dc4100"
    channel: Annotated[int, Ge(0), Le(3), Doc("Channel: 0 ... 3 are LED1 ... LED4")] = 0
    limit_a: Annotated[float, Gt(0), Le(10), OWNERS_LIMIT] | None = None

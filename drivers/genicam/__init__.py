"""GigE Vision and USB3 Vision cameras, over Aravis: their settings."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le
from typing_extensions import Doc

from drivers.camera import ExposureSetting, PitchSetting, RegionSetting
from drivers.genicam._frames import PIXEL_FORMATS


@dataclass(frozen=True, slots=True, kw_only=True)
class GenicamSettings:
    """Selection and settings of a GigE or USB3 Vision camera; what is omitted keeps the camera's value."""

    driver: Literal["genicam"] = "genicam"
    device: Annotated[str, Doc("Name in `svwfs devices`, serial number or address; empty takes the only one")] = ""
    pixel_pitch_m: PitchSetting | None = None
    pixel_format: Annotated[str, Doc('Pixel format, for example "Mono12"; empty: the deepest without padding')] = ""
    full_scale: Annotated[int, Ge(1), Le(65535), Doc("Count of a saturated pixel; omitted: of frames")] | None = None
    byte_order: Annotated[Literal["", "little", "big"], Doc("Byte order of 16-bit pixels; empty: the model's")] = ""
    exposure_s: ExposureSetting | None = None
    gain: Annotated[float, Ge(-1e5), Le(1e5), Doc("Analogue gain in the camera's unit, mostly dB")] | None = None
    frame_rate_hz: Annotated[float, Gt(0), Le(1e6), Doc("Frame rate; omitted: the highest")] | None = None
    binning: Annotated[int, Ge(1), Le(64)] = 1
    region: RegionSetting | None = None
    trigger: Annotated[str, Doc("Trigger: internal, or an input of the camera, such as Line0")] = "internal"
    buffers: Annotated[int, Ge(2), Le(10000), Doc("Frames buffered before the next is lost")] = 32
    packet_size: Annotated[int, Ge(576), Le(65535), Doc("Bytes of a GigE packet; omitted: the largest")] | None = None
    socket_buffer_bytes: Annotated[
        int, Ge(2**16), Le(2**30), Doc("Receive buffer of a GigE camera; the system may grant less (net.core.rmem_max)")
    ] = 2**24
    packet_socket: Annotated[bool, Doc("Packets past the system's network stack: faster, needs root")] = False

    def faults(self) -> Iterator[tuple[str, str]]:
        """Yield settings that contradict others, and why."""
        if self.pixel_format not in {"", *PIXEL_FORMATS}:
            yield "pixel_format", f"must be one of {', '.join(PIXEL_FORMATS)}"

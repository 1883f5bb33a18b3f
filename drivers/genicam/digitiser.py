"""Depth of a GenICam camera's digitiser."""

import re
from functools import partial
from typing import Final

from drivers.genicam.connection import GenicamConnection

FEATURES: Final = ("AdcBitDepth", "SensorBitDepth", "BslSensorBitDepth", "SensorBits")  # "Bit12", "Bpp12" or "12"


def set_digitiser(line: GenicamConnection, wanted_bits: int) -> int | None:
    """Set the digitiser to the smallest depth that suffices, or to its deepest; return the depth, if it is reported.

    A leftover depth of 8 bits would leave the others of a deeper pixel format empty.
    """
    for feature in FEATURES:
        choices = line.attempt(partial(line.choices, feature)) or ()
        depths = {bits: choice for choice in choices if (bits := trailing_number(choice))}
        if depths and line.is_writable(feature):
            best = depths[min((bits for bits in depths if bits >= wanted_bits), default=max(depths))]
            if line.optional_text(feature) != best:
                line.attempt(partial(line.set_text, feature, best))
        if bits := trailing_number(line.optional_text(feature) or ""):
            return bits
    return None


def trailing_number(text: str) -> int:
    """Return the number at the end of a text; 0 if there is none."""
    found = re.search(r"\d+$", text)
    return int(found.group()) if found else 0

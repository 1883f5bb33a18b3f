"""The properties of an open camera: read, written, and asked for their limits."""

from __future__ import annotations

from collections.abc import Iterator
from ctypes import byref, c_char_p, c_double, c_int32, cast, create_string_buffer
from dataclasses import dataclass

from drivers.dcam.errors import NotThere
from drivers.dcam.library import DcamLibrary
from drivers.dcam.property_ids import OPTION_NEXT, TYPE_MASK, TYPE_REAL, Attribute
from drivers.dcam.structures import PropertyAttribute, PropertyValueText, sized
from drivers.device import Property
from drivers.errors import BadValue, DeviceError, Disconnected
from drivers.range import Range

_TEXT_BYTES = 256
_KNOWN_ATTRIBUTES = sum(Attribute)


@dataclass(frozen=True, slots=True)
class Limits:
    """What a property is and allows at this moment."""

    range: Range
    step: float  # 0 where there is none
    kind: int  # of value
    attribute: Attribute
    elements: int  # the property that tells how many elements an array has, 0 where it is none
    element_step: int


class Properties:
    """Reads and writes the properties of one open camera by their numbers; every value is a float on the wire."""

    def __init__(self, library: DcamLibrary, handle: int) -> None:
        self.library = library
        self.handle = handle
        self._known: frozenset[int] | None = None

    def look_again(self) -> None:
        """Ask anew which properties there are, as after a change of mode."""
        self._known = None

    def limits(self, identifier: int) -> Limits:
        """What the property allows in the present mode."""
        told = sized(PropertyAttribute, iProp=identifier)
        self.library.call("dcamprop_getattr", self.handle, byref(told))
        unsigned = told.attribute & 0xFFFFFFFF
        attribute = Attribute(unsigned & _KNOWN_ATTRIBUTES)
        return Limits(
            Range(told.valuemin, told.valuemax),
            told.valuestep if attribute & Attribute.HASSTEP else 0.0,
            unsigned & TYPE_MASK,
            attribute,
            told.iProp_NumberOfElement,
            told.iPropStep_Element,
        )

    def has(self, identifier: int) -> bool:
        """Whether the camera has the property at all, in its present mode."""
        if self._known is None:
            self._known = frozenset(self._identifiers())
        return identifier in self._known

    def get(self, identifier: int) -> float:
        """The value in force."""
        value = c_double()
        self.library.call("dcamprop_getvalue", self.handle, identifier, byref(value))
        return value.value

    def get_or(self, identifier: int, default: float) -> float:
        """The value in force, or the default where the camera does not have the property."""
        return self.get(identifier) if self.has(identifier) else default

    def set(self, identifier: int, value: float) -> float:
        """Write a value; return the one that the camera took."""
        allowed = self.limits(identifier)
        if allowed.step > 0 and not allowed.attribute & Attribute.AUTOROUNDING:
            steps = round((value - allowed.range.minimum) / allowed.step)
            value = min(allowed.range.minimum + steps * allowed.step, allowed.range.maximum)
        taken = c_double(value)
        try:
            self.library.call("dcamprop_setgetvalue", self.handle, identifier, byref(taken), 0)
        except BadValue as error:
            name, least, most = self.name(identifier).lower(), allowed.range.minimum, allowed.range.maximum
            raise BadValue(f"{name} = {value:g}, allowed are {least:g} ... {most:g}: {error}") from error
        return taken.value

    def values(self, identifier: int) -> tuple[int, ...]:
        """All values that a mode or a whole number can take now."""
        allowed = self.limits(identifier).range
        value = c_double(allowed.minimum)
        found = [round(value.value)]
        while value.value < allowed.maximum:
            try:
                self.library.call("dcamprop_queryvalue", self.handle, identifier, byref(value), OPTION_NEXT)
            except (BadValue, NotThere):  # there is no next
                break
            found.append(round(value.value))
        return tuple(found)

    def name(self, identifier: int) -> str:
        """Hamamatsu's own name of the property."""
        text = create_string_buffer(_TEXT_BYTES)
        self.library.call("dcamprop_getname", self.handle, identifier, text, _TEXT_BYTES)
        return text.value.decode(errors="replace")

    def text(self, identifier: int, value: float) -> str:
        """Hamamatsu's own word for a value of a mode."""
        text = create_string_buffer(_TEXT_BYTES)
        asked = sized(PropertyValueText, iProp=identifier, value=value, textbytes=_TEXT_BYTES)
        asked.text = cast(text, c_char_p)
        self.library.call("dcamprop_getvaluetext", self.handle, byref(asked))
        return text.value.decode(errors="replace")

    def readable(self) -> dict[str, Property]:
        """Every property that can be read, by Hamamatsu's names; one that refuses says why in its place."""
        found: dict[str, Property] = {}
        for identifier in self._identifiers():
            allowed = self.limits(identifier)
            if allowed.attribute & Attribute.READABLE:
                name = self.name(identifier)
                try:
                    found[name] = self._worded(identifier, allowed)
                except Disconnected:
                    raise
                except DeviceError as error:
                    found[name] = str(error)
        return found

    def _worded(self, identifier: int, allowed: Limits) -> Property:
        value = self.get(identifier)
        if allowed.attribute & Attribute.HASVALUETEXT:
            return self.text(identifier, value)
        return value if allowed.kind == TYPE_REAL else round(value)

    def _identifiers(self) -> Iterator[int]:
        """All properties, and behind each array its further elements, which are not enumerated."""
        identifier = c_int32(0)
        while self._advance(identifier):
            yield identifier.value
            base = self.limits(identifier.value)
            if base.elements:
                for element in range(1, round(self.get(base.elements))):
                    yield identifier.value + element * base.element_step

    def _advance(self, identifier: c_int32) -> bool:
        try:
            self.library.call("dcamprop_getnextid", self.handle, byref(identifier), 0)
        except NotThere:  # there is no other
            return False
        return identifier.value != 0

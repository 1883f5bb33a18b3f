"""Properties of an open DCAM camera."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from ctypes import byref, c_double, c_int32, create_string_buffer
from dataclasses import dataclass

from drivers.dcam._library import (
    GONE,
    TEXT_BYTES,
    DcamLibrary,
    Denied,
    NotThere,
    PropertyAttribute,
    PropertyValueText,
    sized,
)
from drivers.dcam._property_ids import ALIVE_ONLINE, OPTION_NEXT, TYPE_MASK, TYPE_REAL, Attribute, Id
from drivers.device import Property, Range
from drivers.errors import REFUSALS, BadValue, DeviceError, Disconnected

_KNOWN_ATTRIBUTES = sum(Attribute)


@dataclass(frozen=True, slots=True)
class Limits:
    """Type and present limits of a property."""

    range: Range
    step: float  # 0 if none
    kind: int  # value type
    attribute: Attribute
    elements: int  # property with the number of array elements; 0 for a scalar
    element_step: int


class Properties:
    """Reads and writes properties by number; DCAM passes every value as a float."""

    def __init__(self, library: DcamLibrary, handle: int) -> None:
        self.library = library
        self.handle = handle
        self._known: frozenset[int] | None = None  # all properties in the present mode
        self._remembered: dict[int, float] = {}  # values that a running camera may deny

    def forget_list(self) -> None:
        """Query the list of properties again, as needed after a change of mode."""
        self._known = None
        self._remembered.clear()

    def remember(self, identifiers: Iterable[int]) -> None:
        """Read these properties, if present, so that they stay known while the camera is running."""
        for identifier in identifiers:
            if identifier not in self._remembered and self.has(identifier):
                self._remembered[identifier] = self.get(identifier)

    def limits(self, identifier: int) -> Limits:
        """Limits in the present mode."""
        answer = sized(PropertyAttribute, iProp=identifier)
        self.library.call("dcamprop_getattr", self.handle, byref(answer))
        unsigned = answer.attribute & 0xFFFFFFFF
        attribute = Attribute(unsigned & _KNOWN_ATTRIBUTES)
        return Limits(
            Range(answer.valuemin, answer.valuemax),
            answer.valuestep if attribute & Attribute.HASSTEP else 0.0,
            unsigned & TYPE_MASK,
            attribute,
            answer.iProp_NumberOfElement,
            answer.iPropStep_Element,
        )

    def has(self, identifier: int) -> bool:
        """True if the camera has the property in its present mode."""
        if self._known is None:
            self._known = frozenset(self._identifiers())
        return identifier in self._known

    def get(self, identifier: int) -> float:
        """Value in force; the remembered one if the running camera denies it."""
        value = c_double()
        try:
            self.library.call("dcamprop_getvalue", self.handle, identifier, byref(value))
        except Denied:
            if identifier not in self._remembered:
                raise
            return self._remembered[identifier]
        return value.value

    def get_or(self, identifier: int, default: float) -> float:
        """Value in force, or the default if the camera lacks the property or denies it while running."""
        try:
            return self.get(identifier) if self.has(identifier) else default
        except Denied:
            return default

    def check_online(self) -> None:
        """Raise `Disconnected` if the library knows that the camera is gone."""
        if self.get_or(Id.SYSTEM_ALIVE, ALIVE_ONLINE) != ALIVE_ONLINE:
            raise Disconnected(GONE)

    def set(self, identifier: int, value: float) -> float:
        """Write a value, rounded to its step; return the one in force."""
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
        self._remembered.pop(identifier, None)
        return taken.value

    def set_if_present(self, identifier: int, value: float) -> None:
        """Write a value if the camera has the property."""
        if self.has(identifier):
            self.set(identifier, value)

    def values(self, identifier: int) -> tuple[int, ...]:
        """All present values of a mode or an integer; (1,), the common default, if the camera lacks it."""
        if not self.has(identifier):
            return (1,)
        allowed = self.limits(identifier).range
        value = c_double(allowed.minimum)
        values = [round(value.value)]
        while value.value < allowed.maximum:
            try:
                self.library.call("dcamprop_queryvalue", self.handle, identifier, byref(value), OPTION_NEXT)
            except (BadValue, NotThere):  # no next one
                break
            values.append(round(value.value))
        return tuple(values)

    def name(self, identifier: int) -> str:
        """Hamamatsu's name of the property."""
        text = create_string_buffer(TEXT_BYTES)
        self.library.call("dcamprop_getname", self.handle, identifier, text, TEXT_BYTES)
        return text.value.decode(errors="replace")

    def readable(self) -> dict[str, Property]:
        """All readable properties by Hamamatsu's names; one that fails holds the error message.

        A property whose attributes or name the camera does not report is left out.
        """
        readable: dict[str, Property] = {}
        for identifier in self._identifiers():
            try:
                allowed, name = self.limits(identifier), self.name(identifier)
            except REFUSALS:
                continue
            if allowed.attribute & Attribute.READABLE:
                try:
                    readable[name] = self._worded(identifier, allowed)
                except Disconnected:
                    raise
                except DeviceError as error:
                    readable[name] = str(error)
        return readable

    def _worded(self, identifier: int, allowed: Limits) -> Property:
        value = self.get(identifier)
        if allowed.attribute & Attribute.HASVALUETEXT:
            with suppress(*REFUSALS):
                kind = PropertyValueText
                return self.library.text("dcamprop_getvaluetext", self.handle, kind, iProp=identifier, value=value)
        return value if allowed.kind == TYPE_REAL else round(value)

    def _identifiers(self) -> Iterator[int]:
        """All properties, with the array elements, which DCAM does not enumerate."""
        identifier = c_int32(0)
        while self._advance(identifier):
            yield identifier.value
            with suppress(*REFUSALS):
                base = self.limits(identifier.value)
                count = round(self.get(base.elements)) if base.elements else 1
                for element in range(1, count):
                    yield identifier.value + element * base.element_step

    def _advance(self, identifier: c_int32) -> bool:
        try:
            self.library.call("dcamprop_getnextid", self.handle, byref(identifier), 0)
        except NotThere:  # no next one
            return False
        return identifier.value != 0

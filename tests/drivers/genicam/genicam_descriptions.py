"""Short GenICam descriptions with the nodes of real cameras, as far as the driver meets them.

Own texts with own addresses. Names, types and relations of the nodes are facts of the cameras' own descriptions, which
areaDetector's ADGenICam and aravisGigE collect; their makers' copyright keeps these themselves out of here.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Final

PFNC: Final = {
    "Mono8": 0x01080001,
    "Mono10": 0x01100003,
    "Mono10p": 0x010A0046,
    "Mono10Packed": 0x010C0004,
    "Mono12": 0x01100005,
    "Mono12p": 0x010C0047,
    "Mono12Packed": 0x010C0006,
    "Mono14": 0x01100025,
    "Mono16": 0x01100007,
}
_SCHEMA: Final = (
    'StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1"'
    ' MinorVersion="0" SubMinorVersion="0" ProductGuid="0" VersionGuid="0"'
    ' xmlns="http://www.genicam.org/GenApi/Version_1_1"'
)


@dataclass
class Description:
    """Nodes, each over a register of its own."""

    nodes: list[str] = field(default_factory=list)
    addresses: dict[str, int] = field(default_factory=dict)  # of registers, by feature
    values: dict[str, int] = field(default_factory=dict)  # at power-on
    _free: itertools.count[int] = field(default_factory=lambda: itertools.count(0x10000, 4))

    def register(self, name: str, value: int) -> str:
        """Add a register; return the name of its node."""
        self.addresses[name], self.values[name] = next(self._free), value
        self.nodes.append(
            f'<IntReg Name="{name}Reg"><Address>{self.addresses[name]}</Address><Length>4</Length>'
            "<AccessMode>RW</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable><Sign>Unsigned</Sign>"
            "<Endianess>BigEndian</Endianess></IntReg>"
        )
        return f"{name}Reg"

    def integer(self, name: str, value: int, low: int = 0, high: int = 2**31, step: int = 1, more: str = "") -> None:
        """Add an integer."""
        self.nodes.append(
            f'<Integer Name="{name}">{more}<pValue>{self.register(name, value)}</pValue>'
            f"<Min>{low}</Min><Max>{high}</Max><Inc>{step}</Inc></Integer>"
        )

    def number(self, name: str, value: int, low: float = 0, high: float = 1e7, more: str = "") -> None:
        """Add a float, stored as an integer."""
        self.nodes.append(
            f'<Float Name="{name}">{more}<pValue>{self.register(name, value)}</pValue>'
            f"<Min>{low}</Min><Max>{high}</Max></Float>"
        )

    def boolean(self, name: str, value: int, more: str = "") -> None:
        """Add a boolean."""
        self.nodes.append(
            f'<Boolean Name="{name}">{more}<pValue>{self.register(name, value)}</pValue>'
            "<OnValue>1</OnValue><OffValue>0</OffValue></Boolean>"
        )

    def enumeration(self, name: str, value: str, choices: dict[str, int], more: str = "") -> None:
        """Add an enumeration."""
        entries = "".join(f'<EnumEntry Name="{key}"><Value>{n}</Value></EnumEntry>' for key, n in choices.items())
        self.nodes.append(
            f'<Enumeration Name="{name}">{more}{entries}<pValue>{self.register(name, choices[value])}</pValue>'
            "</Enumeration>"
        )

    def command(self, name: str, register: str, value: int) -> None:
        """Add a command that writes a value."""
        self.nodes.append(
            f'<Command Name="{name}"><pValue>{register}</pValue><CommandValue>{value}</CommandValue></Command>'
        )

    def raw(self, node: str) -> None:
        """Add a node as it is."""
        self.nodes.append(node)

    def basics(self, rows: int, columns: int, formats: tuple[str, ...], *, step: int = 2, offsets: bool = True) -> None:
        """Add what every camera has."""
        sides = (("Width", columns), ("Height", rows))
        for side, length in sides:
            self.integer(f"Sensor{side}", length)
            self.integer(f"{side}Max", length)
            self.integer(side, length, step, length, step)
        for axis in ("OffsetX", "OffsetY") if offsets else ():
            self.integer(axis, 0, 0, max(rows, columns), step)
        self.enumeration("PixelFormat", formats[0], {name: PFNC[name] for name in formats})
        self.integer("PayloadSize", 0)
        self.enumeration("AcquisitionMode", "Continuous", {"Continuous": 0, "SingleFrame": 1})
        running = self.register("Running", 0)
        self.command("AcquisitionStart", running, 1)
        self.command("AcquisitionStop", running, 0)

    def xml(self, vendor: str = "Maker", model: str = "Model") -> bytes:
        """Return the whole description."""
        names = "".join(f"<pFeature>{name}</pFeature>" for name in self.addresses if name != "Running")
        root = f'<Category Name="Root">{names}</Category><Port Name="Device"/>'
        text = f'<RegisterDescription VendorName="{vendor}" ModelName="{model}" {_SCHEMA}>{root}{"".join(self.nodes)}'
        return f'<?xml version="1.0"?>{text}</RegisterDescription>'.encode()

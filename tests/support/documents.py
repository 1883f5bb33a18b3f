"""Python blocks of Markdown documents."""

from __future__ import annotations

import re
from pathlib import Path


def python_blocks(path: Path) -> str:
    """Return the Python blocks of a document as one program, without those that need hardware."""
    blocks = r"(?<!<!-- needs hardware -->\n)^```python\n(.*?)^```"
    return "\n".join(re.findall(blocks, path.read_text("utf-8"), re.DOTALL | re.MULTILINE))


def commands(path: Path) -> list[str]:
    """Return the commands of a document, one line each, without `svwfs` and comments."""
    joined = path.read_text("utf-8").replace("\\\n", " ")
    found = re.findall(r"^    svwfs ((?:(?!  +# ).)+)", joined, re.MULTILINE)
    return [" ".join(command.split()) for command in found]


def named_commands(path: Path) -> list[str]:
    """Return the commands that sentences and tables name, without `svwfs`."""
    return re.findall(r"`svwfs ([^`]+)`", path.read_text("utf-8").replace("\n", " "))

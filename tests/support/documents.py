"""Python blocks of Markdown documents."""

from __future__ import annotations

import re
from pathlib import Path


def python_blocks(path: Path) -> str:
    """Return all Python blocks of a document as one program."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", path.read_text("utf-8"), re.DOTALL | re.MULTILINE))

"""Documentation in the package, without a network: its pages, and the entry of a message in troubleshooting."""

import re
from functools import cache
from pathlib import Path

import app

FIRST_PAGE, TROUBLES = "index.md", "troubleshooting.md"


def documentation() -> Path | None:
    """Return the folder of the documentation, in the package or next to its source; None if missing."""
    package = Path(app.__file__).parent
    return next((each for each in (package / "docs", package.parent / "docs") if (each / FIRST_PAGE).is_file()), None)


def entries() -> dict[str, str]:
    """Return the text of each entry of troubleshooting, by its anchor; none if the documentation is missing."""
    folder = documentation()
    text = "" if folder is None else (folder / TROUBLES).read_text("utf-8")
    sections = (section.partition("\n## ")[0] for section in text.split("\n### ")[1:])
    return {anchor_of(section.partition("\n")[0]): section for section in sections}


def entry_of(message: str) -> str:
    """Return the anchor of the entry that quotes the most characters of a message; empty if none does."""
    return max(((size, anchor) for size, anchor, pattern in _quotes() if pattern.search(message)), default=(0, ""))[1]


def anchor_of(heading: str) -> str:
    """Return the anchor of a heading: `No dark yet` has no-dark-yet."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@cache
def _quotes() -> list[tuple[int, str, re.Pattern[str]]]:
    """Number of fixed characters, anchor and pattern of each quoted message: what is in backticks below a heading."""
    return [
        (len(quote), anchor, re.compile(re.escape(quote).replace(re.escape("..."), ".*?"), re.IGNORECASE | re.DOTALL))
        for anchor, text in entries().items()
        for quote in re.findall(r"`([^`]+)`", text.partition("\n\n")[2].partition("\n\n")[0])
    ]

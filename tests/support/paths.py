"""Folders of the repository that tests read."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
ROOT = TESTS.parent
DOCS = ROOT / "docs"
FOREIGN_FRAMES = TESTS / "support" / "foreign_frames"
"""Frames of another simulator (HCIPy), with truth."""
SMALL_TOML = (TESTS / "support" / "small.toml").read_text("utf-8")
"""A bench of 5 x 7 lenslets that renders at once."""
PRODUCT = sorted(
    path for room in ("app", "drivers", "reconstruction", "simulated_devices") for path in (ROOT / room).rglob("*.py")
)
"""Source files of the product."""

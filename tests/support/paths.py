"""Folders of the repository that tests read."""

from __future__ import annotations

from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
ROOT = TESTS.parent
DOCS = ROOT / "docs"
FOREIGN_FRAMES = TESTS / "support" / "foreign_frames"
"""Frames of another simulator (HCIPy), with truth."""

"""The benches that come with the program, each a TOML file of this folder."""

from pathlib import Path

PRESETS = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.toml"))}
DEFAULT = "live_demo"  # what the program shows
PAPER = "paper_simulation"  # for masks and accuracy
PRESETS["recommended"] = PRESETS[DEFAULT]  # the bench to start from

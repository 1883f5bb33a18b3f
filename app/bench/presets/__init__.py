"""The benches that come with the program, each a TOML file of this folder."""

from pathlib import Path

PRESETS = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.toml"))}
PRESETS["recommended"] = PRESETS["live_demo"]  # the bench to start from is the one that the program shows

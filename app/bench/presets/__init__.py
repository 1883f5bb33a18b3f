"""The benches that come with the program, each a TOML file of this folder."""

from pathlib import Path

PRESETS = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.toml"))}

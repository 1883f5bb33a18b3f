"""The bench: its settings, its TOML file, and the presets."""

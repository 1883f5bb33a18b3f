"""Stand-ins with the wire protocols of real devices, for tests only."""

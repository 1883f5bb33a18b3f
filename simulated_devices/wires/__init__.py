"""Stand-ins that speak the wire protocols of real devices; used by tests only."""

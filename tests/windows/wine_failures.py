"""Tests that fail under Wine alone, not on Windows, and why: `make windows TESTS=1` leaves them out."""

WINE_FAILURES: dict[str, str] = {}

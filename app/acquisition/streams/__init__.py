"""Live results for other programs; docs/results.md describes the messages."""

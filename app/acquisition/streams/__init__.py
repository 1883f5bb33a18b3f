"""Live results for other programs; docs/streams.md describes the messages."""

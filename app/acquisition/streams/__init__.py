"""Live results for other programs; docs/streams.md says what they receive."""

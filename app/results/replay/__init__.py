"""Replay of recordings: verified bit by bit, compared with another bench, or shown live."""

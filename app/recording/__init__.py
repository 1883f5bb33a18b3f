"""Recordings: folders of frames that survive a crash; docs/results.md describes their files."""

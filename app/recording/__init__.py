"""Recordings: folders of frames that survive a crash; docs/recording.md describes their files."""

"""Recordings: a folder of frames that survives whatever ends it; docs/recording.md says what lies in it."""

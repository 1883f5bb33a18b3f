"""The work of each command; `cli` parses its arguments."""

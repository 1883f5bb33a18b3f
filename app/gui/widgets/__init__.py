"""Widgets, scales and formats that the panels and the shell share."""

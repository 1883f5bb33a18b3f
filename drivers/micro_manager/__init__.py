"""Cameras behind Micro-Manager's device adapters, called through pymmcore."""

"""Measurement routines: averages of frames, auto-exposure, background check.

They run in the thread that owns the devices. Each restores camera, light and stage, also when it is cancelled or
fails; after a device fault it turns the light off.
"""

"""Hamamatsu's cameras behind the DCAM-API 4, called through ctypes."""

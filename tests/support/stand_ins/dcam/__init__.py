"""Fake DCAM-API library simulating a C9100-23B, and its test control."""

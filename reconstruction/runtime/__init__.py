"""Compilation, threads, process-wide settings, and deferred values."""

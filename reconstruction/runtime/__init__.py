"""Compilation, threads, and process-wide settings."""

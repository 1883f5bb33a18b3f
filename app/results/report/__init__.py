"""The report of a recording: what was measured, when, with what, and what came out, on pages to read and to print."""

"""Rate and latency of the live path with a window and a recording, and without; for `svwfs benchmark --live`."""

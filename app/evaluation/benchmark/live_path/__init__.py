"""What the live path reaches, with a window and a recording and without; `svwfs benchmark --live`."""

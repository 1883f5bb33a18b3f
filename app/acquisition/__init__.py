"""The live path: devices, worker thread, commands, and publication of results."""

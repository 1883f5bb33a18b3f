"""The device interface and the drivers of real devices."""

"""LED light sources on a serial port."""

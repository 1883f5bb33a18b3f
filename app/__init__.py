"""The application: configuration, acquisition, recording, command line and window."""

"""Checks that every device must pass, in the tests and in `svwfs devices --check`."""

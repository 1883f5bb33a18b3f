"""Errors that end a command: one sentence each, and an exit status for scripts."""

SHOWN = "shown in the window"  # note on an error that the user has seen there
SETTINGS_CHANGED = "the settings changed between these frames: select frames with equal settings (--frames)"


class InputError(Exception):
    """Unusable input: a file, a setting, a frame. Exit status 2."""


class Interrupted(BaseException):
    """The user or the system ended the command early; the text says what was saved. Exit status 130.

    Not an `Exception`, so that no handler mistakes it for a fault.
    """


class RunError(Exception):
    """Failure while running: a device, the disk. Exit status 1."""

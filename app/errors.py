"""How a command ends when it cannot go on: one sentence, and the exit status that tells scripts whose fault it was."""


class InputError(Exception):
    """What was given cannot be used: a file, a setting, a frame. Exit status 2."""


class Interrupted(BaseException):
    """Somebody ended it early, by Ctrl-C or another signal; the text says what there is all the same. Exit status 130.

    No `Exception`, so that nothing takes it for a fault that could be survived.
    """


class RunError(Exception):
    """Something failed while running: a device, the disk. Exit status 1."""

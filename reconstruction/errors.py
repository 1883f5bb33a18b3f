"""The one error of the package."""


class ReconstructionError(ValueError):
    """A frame or a reference from which nothing can be measured; the text says what would be right."""

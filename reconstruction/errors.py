"""The one error of the package."""

from __future__ import annotations


class ReconstructionError(ValueError):
    """A frame or a reference from which nothing can be measured; the text says what would be right.

    `image` says which of them is at fault: "frame", "reference" or "dark"; empty when it is a setting.
    """

    def __init__(self, text: str, *, image: str = "") -> None:
        super().__init__(text)
        self.image = image

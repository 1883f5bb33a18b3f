"""The package's exception."""


class ReconstructionError(ValueError):
    """A frame, reference, dark or setting from which nothing can be measured; the text says what to do.

    `image` names the image at fault ("frame", "reference" or "dark"); empty for a setting.
    """

    def __init__(self, text: str, *, image: str = "") -> None:
        super().__init__(text)
        self.image = image

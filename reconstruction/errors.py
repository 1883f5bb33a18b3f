"""The package's exceptions."""


class ReconstructionError(ValueError):
    """A frame, reference, dark or setting from which nothing can be measured; the text says what to do.

    `image` names the image at fault ("frame", "reference" or "dark"); empty for a setting.
    """

    def __init__(self, text: str, *, image: str = "") -> None:
        super().__init__(text)
        self.image = image


class UnusableSettings(ReconstructionError):
    """Settings that leave nothing to measure: dark and reference are not to blame."""


class TooManyModes(UnusableSettings):
    """More pupil modes than the lenslets can tell apart."""

    def __init__(self, lenslets: int, modes: int) -> None:
        super().__init__(f"{lenslets} valid lenslets cannot determine {modes} pupil modes: take fewer, or automatic")

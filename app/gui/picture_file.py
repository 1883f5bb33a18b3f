"""Picture file of the window."""

from datetime import datetime
from pathlib import Path

from PyQt6.QtCore import QBuffer, QStandardPaths
from PyQt6.QtGui import QPixmap

from app.errors import RunError
from app.files import atomic_write, make_folder


def default_picture() -> Path:
    """Return a new name in the user's picture folder, which is made if it is missing."""
    folder = Path(QStandardPaths.writableLocation(QStandardPaths.StandardLocation.PicturesLocation) or ".")
    make_folder(folder)
    return folder / f"svwfs-{datetime.now().astimezone():%Y%m%d-%H%M%S}.png"


def write_picture(path: Path, picture: QPixmap) -> None:
    """Write a picture in the format that its suffix names; `RunError` if that is impossible."""
    encoded = QBuffer()  # Qt does not notice a full disk
    encoded.open(QBuffer.OpenModeFlag.WriteOnly)
    if not picture.save(encoded, path.suffix.lstrip(".") or "png"):
        raise RunError(f"{path} cannot be written: give a name that ends in .png or .jpg")
    with atomic_write(path) as temporary:
        temporary.write_bytes(encoded.data().data())

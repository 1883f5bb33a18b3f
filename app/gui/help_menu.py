"""The entries of the help menu: messages, documentation, tour, citation and versions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from PyQt6.QtCore import QT_VERSION_STR, QUrl

import app
from app.gui.text_dialog import TextDialog
from app.gui.tour import Tour
from app.run_facts import machine_facts, versions

if TYPE_CHECKING:
    from app.gui.main_window import MainWindow
    from app.gui.menu import Entries

PAPER = (
    'F. Feng, C. Liang, D. Chen, K. Du, R. Yang, C. Lu, S. Chen, L. Chen, L. Tao, and H. Mao, "Space-variant '
    'Shack-Hartmann wavefront sensing based on affine transformation estimation," Applied Optics (2022), '
    "doi:10.1364/AO.471225"
)
_BIBTEX = """@article{Feng2022,
  author  = {Feng, Fan and Liang, Chen and Chen, Dongdong and Du, Ke and Yang, Runjia and Lu, Chang and
             Chen, Shumin and Chen, Liangyi and Tao, Louis and Mao, Heng},
  title   = {Space-variant {Shack-Hartmann} wavefront sensing based on affine transformation estimation},
  journal = {Applied Optics},
  year    = {2022},
  doi     = {10.1364/AO.471225},
}"""
_FIRST_PAGE = "window.md"


def help_entries(window: MainWindow) -> Entries:
    """Return the entries; the help that lists the keys is not among them."""
    return (
        ("Message log", "Ctrl+L", lambda: _show_log(window)),
        ("Documentation", "Shift+F1", lambda: _show_documentation(window)),
        ("Tour of the window", "", lambda: Tour(window).begin()),
        ("How to cite", "", lambda: _show_citation(window)),
        ("About svwfs", "", lambda: _show_about(window)),
    )


def documentation() -> Path | None:
    """Return the folder of the documentation: in the installed package, or beside its source; None if it is missing."""
    package = Path(app.__file__).parent
    return next((each for each in (package / "docs", package.parent / "docs") if (each / _FIRST_PAGE).is_file()), None)


def _show_log(window: MainWindow) -> None:
    dialog = TextDialog("Message log", window, is_fixed_width=True)
    dialog.setObjectName("log")

    def update() -> None:
        dialog.show_log(window.log.text)

    update()
    window.log.changed.connect(update)
    dialog.finished.connect(lambda _: window.log.changed.disconnect(update))
    dialog.show()


def _show_documentation(window: MainWindow) -> None:
    folder = documentation()
    if folder is None:
        window.messages.warn("the documentation is not installed: it is in the folder docs of the source")
        return
    dialog = TextDialog("Documentation", window)
    dialog.setObjectName("documentation")
    dialog.show_page(QUrl.fromLocalFile(str(folder / _FIRST_PAGE)))


def _show_citation(window: MainWindow) -> None:
    dialog = TextDialog("How to cite", window)
    dialog.setObjectName("citation")
    software = f"svwfs {versions()['svwfs']}, a live instrument for space-variant wavefront sensing"
    dialog.show_text(f"The method:\n\n{PAPER}\n\n{_BIBTEX}\n\nThe software:\n\n{software}\n")


def _show_about(window: MainWindow) -> None:
    dialog = TextDialog("About svwfs", window)
    dialog.setObjectName("about")
    installed = versions("zarr")
    facts = {"Version": installed.pop("svwfs", "not installed"), "Licence": "GPL-3.0-or-later"}
    if (status := window.controller.status) is not None:
        facts |= {"Camera": status.camera_name, "Light": status.light_name}
    facts |= {"Recordings": str(window.controller.recordings_folder)}
    machine = {name.capitalize(): str(fact) for name, fact in machine_facts().items()}
    libraries = {"Qt": QT_VERSION_STR, **installed}
    text = "\n".join(f"{name}: {fact}" for name, fact in {**facts, **machine, **libraries}.items())
    dialog.show_text(f"svwfs: a live instrument for space-variant Shack-Hartmann wavefront sensing\n\n{text}\n")

"""Colours, style sheet and icons of the window: dark for a dark lab, or light as the desktop."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from string import Template

from PyQt6.QtCore import QEvent, QMessageLogContext, QObject, QPointF, Qt, QtMsgType, qInstallMessageHandler
from PyQt6.QtGui import QColor, QIcon, QPainter, QPainterPath, QPalette, QPixmap, QPolygonF
from PyQt6.QtWidgets import QApplication, QMessageBox, QWidget

_PAIRS: list[tuple[QColor, str, str]] = []  # of the dark and of the light theme


def _pair(dark: str, light: str) -> QColor:
    """Make a colour of the window, which all parts share and the theme changes."""
    _PAIRS.append((colour := QColor(dark), dark, light))
    return colour


BACKGROUND = _pair("#0b0d10", "#eef0f3")
SURFACE = _pair("#1c2026", "#fafbfc")
RAISED = _pair("#2a3038", "#dfe4ea")
LINE = _pair("#727b87", "#76808b")
TEXT = _pair("#dde2e8", "#1b2026")
DIM = _pair("#98a2ae", "#525d69")
ACCENT = _pair("#4fa3e3", "#1668a8")
GREEN = _pair("#62c073", "#1d7433")
AMBER = _pair("#f0b64a", "#8a5600")
RED = _pair("#ff6a5f", "#c0281c")
DISABLED = _pair("#69727d", "#8b949e")
CHECKED = _pair("#22394c", "#c5dcef")
LIT = _pair("#ffc14d", "#a96d00")  # the lamp of a light that is on
ACCENT_ON_IMAGE, GREEN_ON_IMAGE, AMBER_ON_IMAGE, RED_ON_IMAGE = map(QColor, (ACCENT, GREEN, AMBER, RED))
# An image is as dark in every theme.
_TONES = {"text": TEXT, "dim": DIM, "accent": ACCENT, "green": GREEN, "amber": AMBER, "red": RED}  # of texts
_FOLDER = Path(__file__).parents[1]  # of the style sheet and the icon
_NO_DISPLAY = "svwfs: no window can be opened: correct DISPLAY, or run without a display: QT_QPA_PLATFORM=offscreen"


def _style() -> str:
    """Return the style sheet, in the colours of the theme."""
    colours = {name: each.name() for name, each in globals().items() if isinstance(each, QColor)}
    return Template((_FOLDER / "style.qss").read_text("utf-8")).substitute(colours)


def styled_application() -> QApplication:
    """Return the application, made if there is none, with its name and style, in the colours of the desktop.

    A process whose display cannot be used ends here, with status 1: so nothing is started before.
    """
    application = QApplication.instance()
    if not isinstance(application, QApplication):
        qInstallMessageHandler(_end_without_display)
        application = QApplication(sys.argv[:1])
    application.setApplicationName("svwfs")
    application.setStyle("Fusion")
    _colour(application)
    if (hints := application.styleHints()) is not None:
        hints.colorSchemeChanged.connect(lambda _: _colour(application))
    return application


def _end_without_display(kind: QtMsgType, _context: QMessageLogContext, text: str | None) -> None:
    """Print what Qt says of a display; end with a sentence where Qt would abort."""
    is_fatal = kind is QtMsgType.QtFatalMsg
    sys.stderr.write(f"{_NO_DISPLAY if is_fatal else text}\n")
    if is_fatal:
        os._exit(1)


def show_ending(sentence: str, details: str) -> None:
    """Show why the program ended, with details on request, if there is no terminal."""
    _application = styled_application()  # alive as long as the dialog
    dialog = QMessageBox(QMessageBox.Icon.Critical, "svwfs", sentence)
    dialog.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    dialog.setDetailedText(details)
    dialog.exec()


def use_theme(application: QApplication, name: str) -> None:
    """Use the "light" or "dark" colours from now on, or those of the desktop ("system")."""
    application.setProperty("theme", name)
    _colour(application)


def restyle(widget: QWidget, name: str, value: object) -> None:
    """Set a property that the style sheet looks at."""
    if (widget.property(name) or False) != value and (style := widget.style()) is not None:
        widget.setProperty(name, value)
        style.unpolish(widget)
        style.polish(widget)


def tone(colour: QColor) -> str:
    """Return the name of a theme colour in the style sheet."""
    return next(name for name, one in _TONES.items() if one is colour)


def _colour(application: QApplication) -> None:
    hints, chosen = application.styleHints(), application.property("theme")
    is_desktop_light = hints is not None and hints.colorScheme() is Qt.ColorScheme.Light
    is_light = chosen == "light" or (is_desktop_light and chosen != "dark")
    for colour, *names in _PAIRS:
        colour.setNamedColor(names[is_light])
    palette = QPalette()
    roles = QPalette.ColorRole
    for colour, coloured in (
        (BACKGROUND, (roles.Window, roles.HighlightedText)),
        (SURFACE, (roles.Base,)),
        (RAISED, (roles.AlternateBase, roles.ToolTipBase, roles.Button)),
        (TEXT, (roles.WindowText, roles.Text, roles.ButtonText, roles.ToolTipText)),
        (DIM, (roles.PlaceholderText,)),
        (ACCENT, (roles.Highlight, roles.Link, roles.LinkVisited)),
        (RED, (roles.BrightText,)),
    ):
        for role in coloured:
            palette.setColor(role, colour)
    for role in (roles.WindowText, roles.Text, roles.ButtonText):
        palette.setColor(QPalette.ColorGroup.Disabled, role, DISABLED)
    application.setPalette(palette)
    application.setStyleSheet(_style())
    application.setWindowIcon(QIcon(str(_FOLDER / "svwfs.svg")))


class _Follower(QObject):
    """Calls `paint` at each change of a widget's colours."""

    def __init__(self, widget: QWidget, paint: Callable[[], object]) -> None:
        super().__init__(widget)
        self._paint = paint
        widget.installEventFilter(self)

    def eventFilter(self, watched: QObject | None, event: QEvent | None) -> bool:  # noqa: N802 - Qt's name
        if event is not None and event.type() == QEvent.Type.PaletteChange:
            self._paint()
        return super().eventFilter(watched, event)


def follow(widget: QWidget, paint: Callable[[], object]) -> None:
    """Call `paint`, which sets colours of the theme, now and whenever the theme of a widget changes."""
    paint()
    _Follower(widget, paint)


def lamp(colour: QColor) -> QIcon:
    """Return a small round lamp for a button that shows a state."""
    path = QPainterPath()
    path.addEllipse(6, 6, 20, 20)
    return _icon(path, colour)


def validity_lamp(validity: str) -> QIcon:
    """Return the lamp of a state: a disc if "good", a triangle if "doubtful", else a ring."""
    path = QPainterPath()
    if validity == "doubtful":
        path.addPolygon(QPolygonF([QPointF(16, 4), QPointF(30, 28), QPointF(2, 28)]))
        return _icon(path, AMBER)
    path.addEllipse(5, 5, 22, 22)
    if validity == "good":
        return _icon(path, GREEN)
    path.addEllipse(9, 9, 14, 14)  # a hole: the fill rule is odd-even
    return _icon(path, DIM)


def start_or_stop(*, is_running: bool) -> QIcon:
    """Return the icon of a button: a square stops, a triangle starts."""
    path = QPainterPath()
    if is_running:
        path.addRect(7, 7, 18, 18)
    else:
        path.addPolygon(QPolygonF([QPointF(8, 5), QPointF(27, 16), QPointF(8, 27)]))
    return _icon(path, TEXT if is_running else GREEN)


def _icon(path: QPainterPath, colour: QColor) -> QIcon:
    pixmap = QPixmap(32, 32)
    pixmap.fill(Qt.GlobalColor.transparent)
    painter = QPainter(pixmap)
    painter.setRenderHint(QPainter.RenderHint.Antialiasing)
    painter.fillPath(path, colour)
    painter.end()
    return QIcon(pixmap)

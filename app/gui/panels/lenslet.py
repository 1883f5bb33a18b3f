"""The lenslet inspector: subimages, residual and numbers of the lenslet that was clicked."""

import numpy as np
from PyQt6.QtCore import Qt
from PyQt6.QtGui import QResizeEvent
from PyQt6.QtWidgets import QWidget

from app.gui.panels.panel import DisplayState, Panel, Request
from app.gui.widgets.buttons import Button
from app.gui.widgets.layouts import column, row
from app.gui.widgets.presentation import AdaptiveScale, diverging, number, of_counts, percent, with_error
from app.gui.widgets.texts import ElidedLabel, label
from app.gui.widgets.view_grid import LEAST_LINES, Maps, ViewGrid
from app.results.view_maps import LensletInspection, inspect_lenslet
from reconstruction.displacement import LensletStatus

_GAP_PX = 10  # between two images


class _Images(QWidget):
    """Four images of one size below their names; three share a colour bar, the residual has its own."""

    def __init__(self) -> None:
        super().__init__()
        names = ("Reference", "Frame", "Warped back", "Residual")
        widest = "\N{MINUS SIGN}50000"  # number next to a colour bar
        self.tiles = {name: ViewGrid((0, 0), "", self, widest=widest, is_captioned=False) for name in names}
        self._names = [label(name, "dim", self) for name in names]
        self.tiles["Reference"].setToolTip("Spot image without the sample")
        self.tiles["Warped back"].setToolTip("The frame, warped back onto the reference")
        self.tiles["Residual"].is_hatched = False  # around the image of the field
        for tile in self.tiles.values():
            tile.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setMinimumHeight(self.fontMetrics().height() + 36)

    def resizeEvent(self, event: QResizeEvent | None) -> None:  # noqa: N802 - Qt's name
        super().resizeEvent(event)
        line, bars = self.fontMetrics().height(), (False, False, True, True)
        space = next(iter(self.tiles.values())).bar_space
        side = min((self.width() - 2 * space - 3 * _GAP_PX) // 4, self.height() - line)
        if side < LEAST_LINES * line:  # too low for the numbers
            bars, side = (False,) * 4, min((self.width() - 3 * _GAP_PX) // 4, self.height() - line)
        left = 0
        for name, tile, has_bar in zip(self._names, self.tiles.values(), bars, strict=True):
            tile.has_bar = has_bar
            name.setGeometry(left, 0, max(side, name.sizeHint().width()), line)
            tile.setGeometry(left, line, side + has_bar * space, side)
            left += max(tile.width(), name.sizeHint().width()) + _GAP_PX


class LensletPanel(Panel):
    """Shows one lenslet of the newest frame."""

    title = "Lenslet"

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        self.lenslet: tuple[int, int] | None = None  # row and column
        self._top, self._most = AdaptiveScale(), AdaptiveScale()  # of light and residual, counts
        self._state = ""  # of the lenslet
        self.name = ElidedLabel("title")
        self.numbers, self.quality = ElidedLabel(lines=2), ElidedLabel(lines=2)
        images = _Images()
        self.tiles = images.tiles
        about = "Leave this lenslet out of the wavefront, or use it again; noted in the bench and in recordings"
        self.exclude = Button("Exclude", about, lambda: shown.exclusion_requested.emit([self.lenslet], None))
        header = row((self.name, 1), self.exclude)
        column(header, column(self.numbers, self.quality, spacing=0), (images, 1), parent=self)
        self.select(None)

    def inspect(self, row: int, column: int) -> None:
        """Show a lenslet, in front of the other panels."""
        self.select((row, column))
        self.front_requested.emit()

    def select(self, lenslet: tuple[int, int] | None) -> None:
        self.lenslet = lenslet
        self.exclude.setEnabled(lenslet is not None)
        self._show_state("Click a lenslet in the camera image" if lenslet is None else "")
        self._write("" if lenslet is None else "Computing\N{HORIZONTAL ELLIPSIS}")
        for tile in self.tiles.values():
            tile.show_maps(None)

    def forget_bench(self) -> None:
        self.select(None)

    def show_numbers(self) -> None:
        self._show_state(self._state)

    def show_nothing(self) -> None:
        """Show the last inspection in grey: the newest frame has no wavefront, or no reference."""
        if self.lenslet is not None:
            self._show_state("not measured")
            self._grey(is_grey=True)
            self._write(f"nothing to inspect: {self.shown.problem or 'there is no wavefront'}")

    def request(self) -> Request | None:
        measurement, lenslet = self.shown.measurement, self.lenslet
        if self.shown.wavefront is None or measurement is None or lenslet is None:
            return None
        return Request(measurement, lenslet, lambda _: inspect_lenslet(measurement, *lenslet))

    def show_result(self, found: LensletInspection | None) -> None:
        if found is None:
            self.show_nothing()
            return
        reason = found.outcome.reason
        is_absent = found.outcome is LensletStatus.ABSENT
        self._show_state("lost, " * bool(reason and not is_absent) + (reason or "converged"))
        self._grey(is_grey=self.shown.data_freshness.is_grey)
        self.exclude.setText("Use again" if found.outcome is LensletStatus.EXCLUDED else "Exclude")
        top = max(float(found.reference.max()), float(found.frame.max()), 1.0)
        light = of_counts(self._top.follow(top))
        scales, images = [light] * 4, (found.reference, found.frame, found.fitted, found.residual)
        if found.residual is not None:
            most = max(float(np.nanmax(np.abs(found.residual), initial=0.0)), 1.0)
            scales[-1] = diverging(self._most.follow(most), "")
        for tile, image, scale in zip(self.tiles.values(), images, scales, strict=True):
            tile.show_maps(None if image is None else Maps(image[None, None], scale, _describe))
        self._write(*_numbers(found))

    def _show_state(self, state: str) -> None:
        self._state = state
        name = "" if self.lenslet is None else "Lenslet row {}, column {}".format(*self.lenslet)
        parts = (": ".join(filter(None, (name, state))), self.shown.data_freshness.badge)
        self.name.setText("    ".join(filter(None, parts)))

    def _grey(self, *, is_grey: bool) -> None:
        for tile in self.tiles.values():
            tile.show_stale(is_stale=is_grey)

    def _write(self, numbers: str, quality: str = "") -> None:
        self.numbers.setText(numbers)
        self.quality.setText(quality)


def _numbers(found: LensletInspection) -> tuple[str, str]:
    if not np.isfinite(found.displacement_px).all():
        return "", ""
    x, y = (
        f"{axis} " + " \N{PLUS-MINUS SIGN} ".join(with_error(float(value), float(sigma)))
        for axis, value, sigma in zip("xy", found.displacement_px, found.sigma_px, strict=True)
    )
    parts = [
        f"Residual {percent(found.residual_rms, 1)} of the contrast",
        f"chi-square {number(found.chi_square)}",
        f"{percent(found.range_used)} of the range used",
    ]
    return f"Displacement {x}, {y} px", "    ".join(parts)


def _describe(row: int, column: int, value: float) -> str:
    return f"row {row}, column {column}: {number(value)} counts"

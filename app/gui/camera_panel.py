"""The newest camera frame, with the lattice, the lost lenslets and the mean displacement drawn over it."""

from __future__ import annotations

import numpy as np
import pyqtgraph as pg
from PyQt6.QtCore import QPointF, QRectF, Qt
from PyQt6.QtGui import QColor
from PyQt6.QtWidgets import QComboBox, QHBoxLayout, QVBoxLayout, QWidget

from app.gui import theme
from app.gui.overlay import arrows, lattice_lines, lost_boxes
from app.gui.reasons import REASONS
from app.gui.scale import MAGNIFICATIONS, SteppedScale
from app.gui.widgets import ElidedLabel, label, toggle, unfocused
from drivers.interface import Frame
from reconstruction.displacement import Displacement, Outcome
from reconstruction.geometry import Lattice, Sensor
from reconstruction.lattice.search import Survey

_LEVELS = {"auto levels": "percentiles", "full scale": "full", "hold levels": "hold"}
_LEVELS_INTERVAL_S = 0.5
_LEVELS_PERCENT = (1.0, 99.8)
_LEVELS_SLACK = 0.1  # of their span: smaller changes leave the levels alone
_ARROW_REACH = 0.8  # of a pitch, for all but the longest few arrows


class CameraPanel(QWidget):
    """Shows frames as the camera sees them: +x to the right, +y down."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._frame: Frame | None = None
        self._displacement: Displacement | None = None
        self._lattice: Lattice | None = None
        self._sensor: Sensor | None = None
        self._full_scale = 0
        self._levels, self._levels_time_s = (0.0, 1.0), -np.inf
        self._reach = SteppedScale(MAGNIFICATIONS)  # longest displacement over what fits between two lenslets
        self._pointer: QPointF | None = None

        self.lattice_toggle = toggle("Lattice", "The lenslets' cells; a lost lenslet is crossed out in red (G)")
        self.arrows_toggle = toggle("Arrows", "Where each lenslet's light has moved, averaged over the field (A)")
        for chosen in (self.lattice_toggle, self.arrows_toggle):
            chosen.setChecked(True)
            chosen.toggled.connect(self._show_overlay)
        self._levels_choice = QComboBox()
        self._levels_choice.addItems(list(_LEVELS))
        self._levels_choice.setToolTip("Black and white: 1 % and 99.8 % of the pixels, the detector's range, or as now")
        self._levels_choice.currentIndexChanged.connect(self._restart_levels)
        self._colours = QComboBox()
        self._colours.addItems(["grey", "inferno"])
        self._colours.setToolTip("Colours of the camera image")
        self._colours.currentTextChanged.connect(self._show_colours)

        self._graphics = pg.GraphicsView(background=theme.BACKGROUND)
        self._view = pg.ViewBox(invertY=True, lockAspect=True, enableMenu=False, defaultPadding=0)
        self._graphics.setCentralItem(self._view)
        self._graphics.setMinimumSize(220, 150)
        unfocused(self._graphics)
        self._image = pg.ImageItem(axisOrder="row-major")  # the one place where pyqtgraph must be told
        self._lines = _curve(self._view, theme.ACCENT, alpha=110)
        self._boxes = _curve(self._view, theme.RED, width=2)
        self._found_lines = _curve(self._view, theme.GREEN, width=2)  # of a lattice that is proposed
        self._found_boxes = _curve(self._view, theme.AMBER, width=2)  # its lenslets without light
        self._arrows = _curve(self._view, theme.AMBER)
        self._arrows.setShadowPen(pg.mkPen((0, 0, 0, 200), width=3))  # to be seen on black and on white
        self._view.addItem(self._image)
        self._view.sigRangeChanged.connect(self._place_legend)
        self._view.sigResized.connect(self._place_legend)
        self._graphics.scene().sigMouseMoved.connect(self._point_at)
        self.legend = label("", "on-image", self._graphics)
        self.caption = ElidedLabel("dim")
        self._title = label("Camera", "title")
        self._placeholder = label("no frame yet", "dim")
        self._lay_out()

    def show_running(self, *, is_running: bool) -> None:
        """Say whether the picture is live."""
        self._title.setText("Camera" if is_running or self._frame is None else "Camera, stopped")

    def show_bench(self, sensor: Sensor, lattice: Lattice | None, full_scale: int) -> None:
        """Show on what the coming frames are taken."""
        if (sensor, lattice, full_scale) != (self._sensor, self._lattice, self._full_scale):
            self._sensor, self._lattice, self._full_scale = sensor, lattice, full_scale
            self._show_overlay()

    def propose(self, survey: Survey | None) -> None:
        """Draw a lattice that is not in force yet, and which of its lenslets have no light; or none any more."""
        for item in (self._found_lines, self._found_boxes):
            item.setVisible(survey is not None)
        if survey is not None:
            _draw(self._found_lines, lattice_lines(survey.lattice, *survey.illuminated.shape))
            _draw(self._found_boxes, lost_boxes(survey.lattice, ~survey.illuminated))

    def show_frame(self, frame: Frame, displacement: Displacement | None) -> None:
        """Show a frame, and what has become of its lenslets where that is known."""
        is_new_shape = self._frame is None or self._frame.pixels.shape != frame.pixels.shape
        self._frame, self._displacement = frame, displacement
        self._adapt_levels()
        self._image.setImage(frame.pixels, autoLevels=False, levels=self._levels)
        if is_new_shape:
            self._placeholder.hide()
            rows, columns = frame.pixels.shape
            area = QRectF(-0.5, -0.5, columns, rows)  # pixel centres are at integers
            self._image.setRect(area)
            self._view.setRange(area)
        self._show_overlay()

    def update_text(self) -> None:
        """Say how bright the frame is, and what the pointer points at."""
        if self._frame is None:
            return
        parts = ["+x \N{RIGHTWARDS ARROW}  +y \N{DOWNWARDS ARROW}"]
        if self._full_scale:
            peak = self._frame.pixels.max() / self._full_scale
            parts.append(f"peak {peak:.0%} of full scale" + (", saturated" if peak >= 1 else ""))
            self.caption.setStyleSheet(f"color: {(theme.AMBER if peak >= 1 else theme.DIM).name()};")
        self.caption.setText("    ".join([*parts, self._pointed_at()]))

    def _lay_out(self) -> None:
        header = QHBoxLayout()
        header.addWidget(self._title)
        header.addStretch()
        for widget in (self.lattice_toggle, self.arrows_toggle, self._levels_choice, self._colours):
            header.addWidget(widget)
        QVBoxLayout(self._graphics).addWidget(self._placeholder, alignment=Qt.AlignmentFlag.AlignCenter)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(header)
        layout.addWidget(self._graphics, 1)
        layout.addWidget(self.caption)

    def _restart_levels(self) -> None:
        self._levels_time_s = -np.inf
        if self._frame is not None:
            self.show_frame(self._frame, self._displacement)

    def _show_colours(self, name: str) -> None:
        self._image.setLookupTable(pg.colormap.get(name).getLookupTable(nPts=256) if name != "grey" else None)

    def _adapt_levels(self) -> None:
        """Move the levels, seldom and only when it is worth it, so that the picture does not breathe."""
        frame, choice = self._frame, _LEVELS[self._levels_choice.currentText()]
        if frame is None or choice == "hold" or frame.host_time_s < self._levels_time_s + _LEVELS_INTERVAL_S:
            return
        self._levels_time_s = frame.host_time_s
        low, high = 0.0, float(self._full_scale)
        if choice == "percentiles" or not self._full_scale:
            low, high = (float(level) for level in np.percentile(frame.pixels[::4, ::4], _LEVELS_PERCENT))
        moved = max(abs(low - self._levels[0]), abs(high - self._levels[1]))
        if moved > _LEVELS_SLACK * (self._levels[1] - self._levels[0]):
            self._levels = (low, max(high, low + 1))

    def _show_overlay(self) -> None:
        lattice, sensor, displacement = self._lattice, self._sensor, self._displacement
        has_lattice = lattice is not None and sensor is not None and self.lattice_toggle.isChecked()
        has_arrows = lattice is not None and displacement is not None and self.arrows_toggle.isChecked()
        for item in (self._lines, self._boxes):
            item.setVisible(has_lattice)
        self._arrows.setVisible(has_arrows)
        self.legend.setVisible(has_arrows)
        if has_lattice and lattice is not None and sensor is not None:
            _draw(self._lines, lattice_lines(lattice, sensor.lenslet_rows, sensor.lenslet_columns))
            lost = np.zeros((1, 1), np.bool_) if displacement is None else ~displacement.valid
            _draw(self._boxes, lost_boxes(lattice, lost))
        if has_arrows and lattice is not None and displacement is not None:
            mean_px = displacement.mean
            length_px = np.hypot(mean_px[..., 0], mean_px[..., 1])
            longest_px = np.percentile(length_px[displacement.valid], 98) if displacement.valid.any() else np.nan
            magnification = 1 / self._reach.follow(longest_px / (_ARROW_REACH * lattice.pitch_px))
            _draw(self._arrows, arrows(lattice, mean_px, magnification))
            self.legend.setText(f"displacement \N{MULTIPLICATION SIGN} {magnification:g}")
            self.legend.adjustSize()

    def _place_legend(self, *_: object) -> None:
        """Keep the legend in the corner of the image, or of the view when the image is larger."""
        corner = self._view.mapViewToScene(QPointF(-0.5, -0.5))
        self.legend.move(max(round(corner.x()), 0) + 4, max(round(corner.y()), 0) + 4)

    def _point_at(self, position: QPointF) -> None:
        self._pointer = self._view.mapSceneToView(position)
        self.update_text()

    def _pointed_at(self) -> str:
        """Describe the pixel under the pointer and its lenslet; the tool tip gives a lost lenslet's reason."""
        frame, pointer = self._frame, self._pointer
        if frame is None or pointer is None:
            return ""
        column, row = round(pointer.x()), round(pointer.y())
        if not (0 <= row < frame.pixels.shape[0] and 0 <= column < frame.pixels.shape[1]):
            return ""
        text = f"x {column}  y {row}: {frame.pixels[row, column]} counts"
        lenslet, outcome = self._lenslet_at(np.array([pointer.x(), pointer.y()]))
        lost = REASONS[outcome]
        self._graphics.setToolTip(f"Lenslet {lenslet} is lost: {lost}" if lost else "Wheel: zoom; drag: move")
        return f"{text}    lenslet {lenslet}" + (f": {lost}" if lost else "") if lenslet else text

    def _lenslet_at(self, position_px: np.ndarray[tuple[int], np.dtype[np.float64]]) -> tuple[str, Outcome]:
        if self._lattice is None or self._displacement is None:
            return "", Outcome.CONVERGED
        rows, columns = self._displacement.outcome.shape
        x, y = self._lattice.from_camera_px(position_px) / self._lattice.pitch_px
        column, row = int(np.floor(x + columns / 2)), int(np.floor(y + rows / 2))
        if not (0 <= row < rows and 0 <= column < columns):
            return "", Outcome.CONVERGED
        return f"row {row}, column {column}", Outcome(int(self._displacement.outcome[row, column]))


def _curve(view: pg.ViewBox, colour: QColor, alpha: int = 255, width: int = 1) -> pg.PlotCurveItem:
    """Add an item that draws any number of separate line segments at once."""
    pen = pg.mkPen((colour.red(), colour.green(), colour.blue(), alpha), width=width)
    item = pg.PlotCurveItem(pen=pen, connect="pairs", skipFiniteCheck=True, antialias=False)
    item.setZValue(1)
    view.addItem(item, ignoreBounds=True)
    return item


def _draw(item: pg.PlotCurveItem, ends: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
    item.setData(x=ends[:, 0], y=ends[:, 1])

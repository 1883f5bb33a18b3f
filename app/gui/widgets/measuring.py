"""Tools that measure in the camera picture: along a line, or in an area."""

import math

import numpy as np
import pyqtgraph as pg
from PyQt6.QtCore import QPointF
from PyQt6.QtWidgets import QWidget

from app.gui.widgets import theme
from app.gui.widgets.elements import ElidedLabel, column
from app.gui.widgets.plot import Plot
from app.gui.widgets.presentation import number
from app.results.frame_statistics import FrameStatistics, area_statistics, lengths_of, profile
from drivers.interface import Frame
from reconstruction.arrays import Floats
from reconstruction.geometry import Field, Sensor

_MICRO = "\N{MICRO SIGN}m"


class Measuring(QWidget):
    """A line or an area over the picture, movable by its handles, and below the picture what it measures."""

    def __init__(self, view: pg.ViewBox) -> None:
        super().__init__()
        pen, hovered = (pg.mkPen(colour, width=2) for colour in (theme.GREEN_ON_IMAGE, theme.AMBER_ON_IMAGE))
        look = {"pen": pen, "hoverPen": hovered, "handlePen": pen}
        self.line = pg.LineSegmentROI([(0, 0), (1, 0)], **look)
        self.area = pg.RectROI((0, 0), (1, 1), **look)
        for item in (self.line, self.area):
            item.setZValue(2)
            item.hide()
            item.sigRegionChanged.connect(self._read)
            view.addItem(item, ignoreBounds=True)
            for handle in item.getHandles():
                handle.setDeletable(False)
                handle.menu.deleteLater()  # to delete it: no parent would
                handle.menu = None
        self._frame: Frame | None = None
        self._statistics: FrameStatistics | None = None
        self._sensor: Sensor | None = None
        self._field: Field | None = None
        self.reading = ElidedLabel()
        self.plot = Plot("", "px along the line, counts", widest="65000")
        self.plot.title.hide()
        self.plot.graphics.setFixedHeight(7 * self.fontMetrics().height())
        self.curve = self.plot.add_curve(theme.GREEN, 1)
        column(self.reading, self.plot, spacing=2, parent=self)
        self.hide()

    def place(self, kind: str, start: QPointF, end: QPointF) -> None:
        """Measure along a "line" between two points, or in an "area" of which they are corners.

        Points farther from the frame than its width and height are moved there: a line has no end otherwise.
        """
        start, end = self._near(start), self._near(end)
        (left, right), (top, bottom) = sorted((start.x(), end.x())), sorted((start.y(), end.y()))
        if kind == "line":
            ends = [(point.x(), point.y()) for point in (start, end)]
            self.line.setState({"pos": (0, 0), "size": (1, 1), "angle": 0, "points": ends})
        else:
            self.area.setPos((left, top), finish=False)
            self.area.setSize((right - left, bottom - top))
        self.line.setVisible(kind == "line")
        self.area.setVisible(kind == "area")
        self._read()

    def _near(self, point: QPointF) -> QPointF:
        rows, columns = (0, 0) if self._frame is None else self._frame.pixels.shape
        return QPointF(min(max(point.x(), -columns), 2 * columns), min(max(point.y(), -rows), 2 * rows))

    def use(self, kind: str) -> None:
        """Remove line and area, and make room for the next "line" or "area"; the picture must not move under it."""
        for item in (self.line, self.area):
            item.hide()
        self.curve.setData([], [])
        self.reading.setText("")
        self.plot.setVisible(kind == "line")
        self.setVisible(kind in {"line", "area"})

    def show_bench(self, sensor: Sensor, field: Field) -> None:
        """Use these for lengths in metres."""
        self._sensor, self._field = sensor, field

    def show_frame(self, frame: Frame, statistics: FrameStatistics | None) -> None:
        """Measure in another frame; `statistics` have the count from which pixels are saturated."""
        self._frame, self._statistics = frame, statistics
        self._read()

    def _read(self) -> None:
        if self._frame is None:
            return
        if self.line.isVisible():
            start, end = (self.line.mapToParent(point) for point in self.line.listPoints())
            self.curve.setData(*self._profile(self._frame, start, end), connect="finite")
            self.reading.setText(self._length(math.hypot(end.x() - start.x(), end.y() - start.y())))
        elif self.area.isVisible():
            self.reading.setText(self._statistics_of(self._frame))

    def _profile(self, frame: Frame, start: QPointF, end: QPointF) -> tuple[Floats, Floats]:
        along_px, counts = profile(frame.pixels, (start.x(), start.y()), (end.x(), end.y()))
        known = counts[np.isfinite(counts)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
        self.plot.set_ranges((0, max(float(along_px[-1]), 1.0)), (low, max(high, low + 1)))
        return along_px, counts

    def _length(self, length_px: float) -> str:
        sensor, field = self._sensor, self._field
        if sensor is None or field is None:
            return f"{length_px:.1f} px"
        length_m, angle_rad, source_m = lengths_of(length_px, sensor, field)
        return (
            f"{length_px:.1f} px = {number(length_m * 1e6, 4)} {_MICRO} on the sensor; within a subimage"
            f" {number(angle_rad * 1e3)} mrad, {number(source_m * 1e3)} mm of the source"
        )

    def _statistics_of(self, frame: Frame) -> str:
        place, size = self.area.pos(), self.area.size()
        sides = (place.x(), place.x() + size.x()), (place.y(), place.y() + size.y())
        clip_level = math.inf if self._statistics is None else self._statistics.clip_level
        if (found := area_statistics(frame.pixels, *sides, clip_level)) is None:
            return "no pixel lies in the area"
        pitch_um = math.nan if self._sensor is None else self._sensor.pixel_pitch_m * 1e6
        size_um = f" = {number(found.columns * pitch_um, 4)} x {number(found.rows * pitch_um, 4)} {_MICRO}"
        return (
            f"{found.columns} x {found.rows} px{size_um * (self._sensor is not None)}: mean {number(found.mean, 5)},"
            f" \N{GREEK SMALL LETTER SIGMA} {number(found.sigma, 4)}, {found.lowest} ... {found.highest} counts,"
            f" {found.clipped} saturated"
        )

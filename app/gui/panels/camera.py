"""The camera panel: the newest frame below lattice, lost lenslets and mean displacements."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from PyQt6.QtCore import QPointF, Qt, pyqtSignal
from PyQt6.QtWidgets import QWidget

from app.acquisition.instrument import Status
from app.gui.panels.panel import DisplayState, Entries, MoreEntries, Panel, Request
from app.gui.widgets import camera_image, theme
from app.gui.widgets.buttons import Choice, checkable
from app.gui.widgets.camera_image import CameraImage, DrawingView, Picture, Segments
from app.gui.widgets.copies import as_table
from app.gui.widgets.layouts import column, row_of, unfocused
from app.gui.widgets.presentation import MAGNIFICATIONS, AdaptiveScale, percent
from app.gui.widgets.texts import ElidedLabel, colour_text, label
from app.measurement.measurement import Measurement
from app.progress import counted
from app.results.frame_statistics import FrameStatistics, frame_statistics
from drivers.interface import Frame
from reconstruction.displacement import Displacement, LensletStatus
from reconstruction.geometry import Lattice, Sensor
from reconstruction.lattice.search import Survey
from reconstruction.pupil import Pupil

_CONTRAST_TIP = "Contrast: automatic (1 % to 99.8 % of the pixels), full range, or frozen"
_FULL, _FROZEN = "Full range", "Frozen contrast"
_CONTRASTS = ("Auto contrast", _FULL, _FROZEN)
_LEVELS_SLACK = 0.1  # of their span: smaller changes leave black and white alone, so that nothing flickers
_MOST_COUNTS = 65535  # while the full scale is unknown
_CLOSEST_PX = 8  # side of the smallest area that fills the view
_FARTHEST = 2.0  # widths and heights of the frame that the view shows at most
_HINT = (
    "+x: to the right; +y: down\n"
    "Wheel: zoom; drag: move; 0: whole frame\n"
    "Click: inspect the lenslet; right click: exclude it, copy picture or displacements"
)
_TOOLS = {  # what to drag over the picture
    "inspect": "",
    "pupil": "a circle from its middle to its edge: wavefronts are shown within",
    "exclude": "a rectangle around the lenslets to leave out",
    "use again": "a rectangle around the lenslets to use again",
}
_TOOL_TIP = (
    "What a drag over the picture does: move it, draw the pupil over which wavefronts are shown,\n"
    "exclude all lenslets in a rectangle, or use them again. Esc ends it; the middle button always moves."
)
_ARROW_REACH = 0.8  # pitches, for all but the longest few arrows

Lenslet = tuple[int, int]  # row and column


class CameraPanel(Panel):
    """Shows frames as the camera sees them: +x to the right, +y down."""

    title, is_tab = "Camera", False
    lenslet_clicked = pyqtSignal(int, int)  # row and column

    def __init__(self, shown: DisplayState) -> None:
        super().__init__(shown)
        self.counts_for: tuple[Panel, ...] = ()  # other panels that show the counts
        self._frame: Frame | None = None
        self._displacement: Displacement | None = None
        self._lattice: Lattice | None = None
        self._sensor: Sensor | None = None
        self.full_scale = 0  # highest count; 0 is unknown
        self._reach = AdaptiveScale(MAGNIFICATIONS)  # longest arrow over its space
        self._magnification = 1.0  # of the arrows
        self._pointer: QPointF | None = None
        self._inspected: Lenslet | None = None

        cells = "Show the lenslets' cells; lost lenslets are crossed out in red (G)"
        moved = "Show each lenslet's displacement, averaged over the field (A)"
        self.lattice_toggle = checkable(self, "Lattice", cells, self._show_overlay, is_on=True, key="camera/lattice")
        self.arrows_toggle = checkable(self, "Arrows", moved, self._show_overlay, is_on=True, key="camera/arrows")
        colours = "False colours (inferno) in place of grey"
        self.colours = checkable(self, "False colours", colours, self._draw, key="camera/colours")
        self.contrast = Choice(_CONTRAST_TIP, _CONTRASTS, self._adapt_contrast, key="camera/contrast")
        self.tool = Choice(_TOOL_TIP, [(name.capitalize(), name) for name in _TOOLS], self._use_tool)
        self._make_picture()
        self.caption = ElidedLabel("dim", lines=2, least=2)  # the picture must not move under a drag
        self.header = row_of(self.tool, self.contrast, (QWidget(), 1))
        column((self._graphics, 1), self.caption, spacing=2, parent=self)
        self.badge, self._placeholder = label("", "badge", is_wrapped=True), label("No frame yet", "dim")
        self.badge.hide()
        over = column(self.badge, (self._placeholder, 1), parent=self._graphics)
        over.setAlignment(self.badge, Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignTop)
        over.setAlignment(self._placeholder, Qt.AlignmentFlag.AlignCenter)

    def _make_picture(self) -> None:
        self._graphics = Picture(self._point_at)
        self._view = DrawingView(invertY=True, lockAspect=True, enableMenu=False, defaultPadding=0)
        self._graphics.setCentralItem(self._view)
        self._graphics.setMinimumSize(220, 70)
        unfocused(self._graphics)
        self._image = CameraImage(self._view)
        self._lines = Segments(self._view, theme.ACCENT_ON_IMAGE, alpha=150)
        self._boxes = Segments(self._view, theme.RED_ON_IMAGE, width=2)
        self._proposed_lines = Segments(self._view, theme.GREEN_ON_IMAGE, width=2)
        self._proposed_boxes = Segments(self._view, theme.AMBER_ON_IMAGE, width=2)  # lenslets without light
        self._arrows = Segments(self._view, theme.AMBER_ON_IMAGE, width=2, shadow=4)  # visible on black and on white
        self._inspected_box = Segments(self._view, theme.ACCENT_ON_IMAGE, width=2)
        self._pupil = Segments(self._view, theme.GREEN_ON_IMAGE, width=2)
        self._drawn = Segments(self._view, theme.AMBER_ON_IMAGE, width=2)  # while a tool is dragged
        self._view.drawn.connect(self._draw_with_tool)
        self._view.sigRangeChanged.connect(self._keep_in_sight)
        self._view.sigResized.connect(self._keep_in_sight)
        self._graphics.scene().sigMouseMoved.connect(self._point_at)
        self._graphics.scene().sigMouseClicked.connect(self._click)

    def menu_entries(self) -> Mapping[str, Entries]:
        return {
            "&View": (
                ("Lattice", "G", self.lattice_toggle),
                ("Arrows", "A", self.arrows_toggle),
                ("Whole camera image", "0", self.reset_zoom),
                None,
            )
        }

    def more_entries(self) -> MoreEntries:
        """Return entries also for the lenslet under the pointer, after a right click."""
        shown = self.lattice_toggle, self.arrows_toggle, self.colours
        if self._pointer is None or (lenslet := self._lenslet_at(self._pointer)) is None:
            return shown
        name = "lenslet row {}, column {}".format(*lenslet)
        exclude = partial(self.shown.exclusion_requested.emit, [lenslet], None)
        inspect = partial(self.inspect, lenslet)
        return (f"Inspect {name}", inspect), (f"Exclude {name}, or use it again", exclude), *shown

    def table(self) -> str:
        """Return the displacement of each lenslet."""
        if self._displacement is None:
            return ""
        mean_px = self._displacement.mean
        rows = (np.array([*at, *mean_px[at]]) for at in np.ndindex(mean_px.shape[:2]))
        return as_table(("row", "column", "x (px)", "y (px)"), rows)

    def catch_up(self) -> None:
        super().catch_up()
        self._show_overlay()

    def _show_badge(self) -> None:
        shown = self.shown.data_freshness
        if shown.badge != self.badge.text():
            self.badge.setText(shown.badge)
            self.badge.setVisible(bool(shown.badge))
        if shown.reason != self.badge.toolTip():
            self.badge.setToolTip(shown.reason)

    def show_stale(self, *, is_stale: bool) -> None:
        self._view.childGroup.setOpacity(0.5 if is_stale else 1.0)

    def show_status(self, status: Status) -> None:
        self.show_bench(status.bench.sensor, status.lattice, status.capabilities.full_scale)

    def show_bench(self, sensor: Sensor, lattice: Lattice | None, full_scale: int) -> None:
        if (sensor, lattice, full_scale) != (self._sensor, self._lattice, self.full_scale):
            self._sensor, self._lattice, self.full_scale = sensor, lattice, full_scale
            self._show_overlay()

    def forget_bench(self) -> None:
        self.put_tool_away()
        self._lattice = self._sensor = self._displacement = self._inspected = self.shown.statistics = None
        self._show_overlay()

    @property
    def is_needed(self) -> bool:
        """True if one of the panels that show the counts is seen."""
        return any(panel.isVisible() for panel in (self, *self.counts_for))

    def request(self) -> Request | None:
        measurement, full_scale = self.shown.measurement, self.full_scale
        if measurement is None:
            return None
        return Request(measurement, full_scale, lambda _: frame_statistics(measurement.frame.pixels, full_scale))

    def show_result(self, found: FrameStatistics) -> None:
        self.shown.statistics = found
        self._adapt_contrast()

    def propose(self, survey: Survey | None) -> None:
        for item in (self._proposed_lines, self._proposed_boxes):
            item.setVisible(survey is not None)
        if survey is not None:
            self._proposed_lines.draw(camera_image.lattice_lines(survey.lattice, *survey.illuminated.shape))
            self._proposed_boxes.draw(camera_image.lost_boxes(survey.lattice, ~survey.illuminated))

    def show_measurement(self, measurement: Measurement) -> None:
        frame, wavefront = measurement.frame, measurement.wavefront
        is_new_shape = self._frame is None or self._frame.pixels.shape != frame.pixels.shape
        self._frame, self._displacement = frame, None if wavefront is None else wavefront.displacement
        self._draw()
        if is_new_shape:
            self._placeholder.hide()
            self._view.setLimits(minXRange=_CLOSEST_PX, minYRange=_CLOSEST_PX)
            self.reset_zoom()
        self._show_overlay()

    def _draw(self) -> None:
        if self._frame is not None:
            black, white = self.shown.levels or (0, self.full_scale or _MOST_COUNTS)
            found = self.shown.statistics
            clip_level = found.clip_level if found is not None and found.clipped_share else None
            colours = "inferno" if self.colours.isChecked() else "grey"
            self._image.show_counts(self._frame.pixels, colours, black, white, clip_level)

    def _adapt_contrast(self) -> None:
        """Follow statistics or full scale; a remembered frozen contrast begins with those of its first frame."""
        found, choice = self.shown.statistics, self.contrast.currentText()
        if choice == _FULL and self.full_scale:
            low, high = 0, self.full_scale
        elif found is not None and (choice != _FROZEN or self.shown.levels is None):
            low, high = found.usual
        else:
            return
        black, white = self.shown.levels or (0.0, 0.0)
        if max(abs(low - black), abs(max(high, low + 1) - white)) > _LEVELS_SLACK * (white - black):
            self.shown.levels = low, max(high, low + 1)
            self._draw()

    def reset_zoom(self) -> None:
        if self._frame is not None:
            self._view.setRange(self._image.boundingRect())

    def show_numbers(self) -> None:
        self._show_badge()
        self._pupil.draw(camera_image.pupil_edges(self._lattice, self._sensor, self.shown.pupil))
        if self._frame is None:
            return
        parts, colour = list[str](), theme.DIM
        found = self.shown.statistics
        if found is not None and self.full_scale:
            brightness = f"Peak {percent(found.peak / self.full_scale)} of full scale"
            if found.clipped_share:
                share = percent(found.clipped_share, 1) if found.clipped_share >= 0.001 else "< 0.1 %"
                brightness, colour = f"{brightness}, {share} of the pixels clipped", theme.RED
            elif found.is_nearly_full:
                brightness, colour = f"{brightness}: nearly saturated, shorten the exposure", theme.AMBER
            parts.append(brightness)
        colour_text(self.caption, colour)
        has_arrows = self._arrows.isVisible() and colour is theme.DIM  # a warning needs the space
        length = f"Arrows \N{MULTIPLICATION SIGN} {self._magnification:g}" if has_arrows else ""
        self.caption.setText("    ".join([*parts, self._pointed_at() or length]))

    def put_tool_away(self) -> None:
        """Let drags move the picture again."""
        self.tool.setCurrentIndex(0)
        self._use_tool()

    def _use_tool(self) -> None:
        self._view.is_drawing = bool(drag := _TOOLS[self.tool.currentData()])
        self._drawn.draw(np.zeros((0, 2)))
        if self._view.is_drawing:
            self.informed.emit(f"drag over the camera picture: {drag}; Esc ends it")
            self._graphics.setCursor(Qt.CursorShape.CrossCursor)
        else:
            self._graphics.unsetCursor()

    def _draw_with_tool(self, start: QPointF, end: QPointF, is_finished: bool) -> None:
        tool = self.tool.currentData()
        if tool == "pupil":
            self._draw_pupil(start, end, is_finished)
            return
        self._drawn.draw(np.zeros((0, 2)) if is_finished else camera_image.rectangle(start, end))
        if is_finished:
            lenslets = self._lenslets_between(start, end)
            if lenslets:
                self.shown.exclusion_requested.emit(lenslets, tool == "exclude")
                undo = '"use again"' if tool == "exclude" else '"exclude"'
                self.informed.emit(f"{tool}: {counted(len(lenslets), 'lenslet')}; the same with {undo} undoes it")
            else:
                self.warned.emit("no centre of a lenslet lies in the rectangle")

    def _draw_pupil(self, middle: QPointF, edge: QPointF, is_finished: bool) -> None:
        """Draw a circle, and show wavefronts within it; the present pupil keeps its obscuration."""
        lattice, sensor, before = self._lattice, self._sensor, self.shown.pupil
        if lattice is None or sensor is None:
            return
        ends_px = np.array([(middle.x(), middle.y()), (edge.x(), edge.y())])
        (x_m, y_m), end_m = lattice.in_pitches(ends_px) * sensor.lenslet_pitch_m
        radius_m = max(math.dist((x_m, y_m), end_m), 1e-9)
        pupil = Pupil.round((float(x_m), float(y_m)), radius_m, 0.0 if before is None else before.obscuration)
        self._drawn.draw(np.zeros((0, 2)) if is_finished else camera_image.pupil_edges(lattice, sensor, pupil))
        if is_finished and pupil.contains(sensor.lenslet_centers_m).any():
            self.shown.pupil_drawn.emit(pupil)
        elif is_finished:
            self.warned.emit("no centre of a lenslet lies in the circle")

    def _lenslets_between(self, start: QPointF, end: QPointF) -> list[Lenslet]:
        if self._lattice is None or self._sensor is None:
            return []
        at = self._lattice.lenslet_centers_px(*self._sensor.lenslets)
        corners = np.sort([[start.x(), start.y()], [end.x(), end.y()]], axis=0)
        inside = np.all((at >= corners[0]) & (at <= corners[1]), axis=-1)
        return [(int(row), int(column)) for row, column in np.argwhere(inside)]

    def _click(self, event: Any) -> None:  # pyqtgraph declares no types
        """Inspect a lenslet at a left click, unless a tool is in use."""
        if event.button() == Qt.MouseButton.LeftButton and not self._view.is_drawing:
            self.inspect(self._lenslet_at(self._view.mapSceneToView(event.scenePos())))

    def _lenslet_at(self, at: QPointF) -> Lenslet | None:
        sensor = self._sensor
        if sensor is None or self._lattice is None:
            return None
        return camera_image.lenslet_at(self._lattice, sensor.lenslets, at.x(), at.y())

    def inspect(self, lenslet: Lenslet | None) -> None:
        self._inspected = lenslet
        self._show_overlay()
        if lenslet is not None:
            self.lenslet_clicked.emit(*lenslet)

    def _show_overlay(self) -> None:
        if not self.isVisible():
            return
        lattice, sensor, displacement = self._lattice, self._sensor, self._displacement
        has_lattice = lattice is not None and sensor is not None and self.lattice_toggle.isChecked()
        has_arrows = lattice is not None and displacement is not None and self.arrows_toggle.isChecked()
        for item in (self._lines, self._boxes):
            item.setVisible(has_lattice)
        self._arrows.setVisible(has_arrows)
        self._inspected_box.setVisible(lattice is not None and self._inspected is not None)
        if lattice is None or sensor is None:
            return
        if has_lattice:
            self._lines.draw(camera_image.lattice_lines(lattice, *sensor.lenslets))
            is_lost = np.zeros((1, 1), np.bool_) if displacement is None else displacement.present & ~displacement.valid
            self._boxes.draw(camera_image.lost_boxes(lattice, is_lost))
        if self._inspected is not None:
            self._inspected_box.draw(camera_image.cell_border(lattice, sensor.lenslets, self._inspected))
        if has_arrows and displacement is not None:
            room_px, mean_px = _ARROW_REACH * lattice.pitch_px, displacement.mean
            self._magnification = 1 / self._reach.follow(camera_image.arrow_length_px(mean_px) / room_px)
            self._arrows.draw(camera_image.arrows(lattice, mean_px, self._magnification))

    def _keep_in_sight(self, *_: object) -> None:
        """Keep the frame at the middle of the view, and at no less than half its size."""
        if self._frame is None:
            return
        area, seen = self._image.boundingRect(), self._view.viewRect()
        if min(seen.width() / area.width(), seen.height() / area.height()) > _FARTHEST:
            self.reset_zoom()
            return
        middle = seen.center()
        x = min(max(middle.x(), area.left()), area.right()) - middle.x()
        y = min(max(middle.y(), area.top()), area.bottom()) - middle.y()
        if x or y:
            self._view.translateBy(x=x, y=y)

    def _point_at(self, position: QPointF | None = None) -> None:
        self._pointer = None if position is None else self._view.mapSceneToView(position)
        self.show_numbers()

    def _pointed_at(self) -> str:
        """Describe the pixel under the pointer and its lenslet; set the tool tip."""
        frame, pointer = self._frame, self._pointer
        if frame is None or pointer is None:
            return ""
        x, y = round(pointer.x()), round(pointer.y())
        if not (0 <= y < frame.pixels.shape[0] and 0 <= x < frame.pixels.shape[1]):
            return ""
        text = f"x {x}  y {y}: {frame.pixels[y, x]} counts"
        displacement, lattice, lenslet = self._displacement, self._lattice, None
        if displacement is not None and lattice is not None:
            lenslet = camera_image.lenslet_at(lattice, displacement.outcome.shape, pointer.x(), pointer.y())
        self._graphics.setToolTip(_HINT)
        if displacement is None or lenslet is None:
            return text
        name, reason = "row {}, column {}".format(*lenslet), LensletStatus(int(displacement.outcome[lenslet])).reason
        if not reason:
            return f"{text}    lenslet {name}"
        self._graphics.setToolTip(f"Lenslet {name}: {reason}")
        return f"{text}    lenslet {name}: {reason}"

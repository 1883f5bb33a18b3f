"""The figure of a result shows its wavefronts, and NaN where they are unknown."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.gui_bench import FIELD
from support.wavefronts import bowl, modal

from app.results.figures import views_figure
from reconstruction.arrays import Floats
from reconstruction.wavefront import rms


def maps_and_titles(figure: Figure) -> tuple[list[Floats], list[str]]:
    """The images in a figure, NaN where they are masked, and the titles of all axes."""
    images = [axis.images[0].get_array() for axis in figure.axes if axis.images]
    return [np.ma.filled(each, np.nan) for each in images if each is not None], [
        each.get_title() for each in figure.axes
    ]


def test_figure_holds_wavefronts_point_spread_functions_and_curves() -> None:
    wavefront = bowl()
    wavefront.views[0, 0] = np.nan
    wavefront.views[1, 1] = 0.0
    figure = views_figure(wavefront)
    maps, titles = maps_and_titles(figure)
    np.testing.assert_array_equal(np.stack(maps[:9]), wavefront.views.reshape(9, *wavefront.views.shape[2:]))
    assert np.isnan(maps[9]).all()
    flat = maps[9 + 4]
    assert flat[flat.shape[0] // 2, flat.shape[1] // 2] == flat.max() == pytest.approx(1)
    captions = [title for title in titles if "Strehl" in title]
    assert captions[4] == "(+0.00, +0.00) mm\nStrehl 1.000  peak 1.000"
    sentence = r"a single correction would leave \d\.\d\d rad RMS\n\d\.\d\d rad without tilt"
    assert any(re.fullmatch(sentence, title) for title in titles)


def test_single_view_is_drawn_with_its_numbers() -> None:
    wavefront = bowl()
    single = replace(wavefront, field=replace(FIELD, view_rows=1, view_columns=1), views=wavefront.views[:1, :1])
    figure = views_figure(single)
    figure.draw_without_rendering()
    (drawn, _), (title, *_) = maps_and_titles(figure)
    np.testing.assert_array_equal(drawn, wavefront.views[0, 0])
    assert title == f"(+0.00, +0.00) mm\nRMS {rms(drawn):.3f}  PV {np.nanmax(drawn) - np.nanmin(drawn):.2f} rad"
    texts = [
        text for axis in figure.axes for text in (axis.title, axis.xaxis.label, axis.yaxis.label) if text.get_text()
    ]
    boxes = [text.get_window_extent() for text in texts]
    assert len(boxes) == 9
    whole = figure.bbox
    assert all(whole.x0 <= box.x0 and box.x1 <= whole.x1 and whole.y0 <= box.y0 and box.y1 <= whole.y1 for box in boxes)
    assert not [pair for pair in itertools.combinations(boxes, 2) if pair[0].overlaps(pair[1])]


def test_unknown_views_are_drawn_without_numbers() -> None:
    wavefront = bowl()
    figure = views_figure(replace(wavefront, views=wavefront.views * np.nan))
    figure.draw_without_rendering()
    maps, titles = maps_and_titles(figure)
    assert len(maps) == 18
    assert all(np.isnan(each).all() for each in maps)
    for numbers in ("RMS nan  PV nan rad", "Strehl nan  peak nan"):
        assert sum(numbers in title for title in titles) == 9


def test_single_wavefront_for_the_whole_field_has_no_curve_over_separation() -> None:
    """It would be flat: a single correction leaves nothing."""
    titles = maps_and_titles(views_figure(modal(np.array([[0.0], [0.3], [0.0], [0.5]]))))[1]
    assert any(title.startswith("modulation transfer") for title in titles)
    assert not any("single correction" in title for title in titles)

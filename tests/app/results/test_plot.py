"""The picture of a result draws what is known, and says so where nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.gui_bench import FIELD, SENSOR
from support.wavefronts import bowl

from app.results.plot import views_figure


def test_figure_holds_wavefronts_point_spread_functions_and_curves() -> None:
    wavefront = bowl()
    wavefront.views[0, 0] = np.nan
    wavefront.views[1, 1] = 0.0
    figure = views_figure(wavefront, SENSOR)
    images = [axis.images[0].get_array() for axis in figure.axes if axis.images]
    maps = [np.ma.filled(image, np.nan) for image in images if image is not None]
    np.testing.assert_array_equal(np.stack(maps[:9]), wavefront.views.reshape(9, *wavefront.views.shape[2:]))
    assert np.isnan(maps[9]).all()
    flat = maps[9 + 4]
    assert flat[flat.shape[0] // 2, flat.shape[1] // 2] == flat.max() == pytest.approx(1)
    captions = [axis.get_title() for axis in figure.axes if "Strehl" in axis.get_title()]
    assert captions[4] == "(+0.00, +0.00) mm\nStrehl 1.000  peak 1.000"
    titles = [axis.get_title() for axis in figure.axes]
    assert any(title.startswith("one wavefront for the whole field is off by") for title in titles)


def test_nothing_known_and_a_single_view_make_a_picture_too() -> None:
    single = replace(FIELD, view_rows=1, view_columns=1)
    wavefront = bowl()
    for views in (wavefront.views * np.nan, wavefront.views):
        figure = views_figure(replace(wavefront, field=single, views=views[:1, :1]), SENSOR)
        figure.canvas.draw()

"""Means over frames: RMS, its scatter, noise, and comparisons of two benches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.gui_bench import BENCH, FIELD, make_measurement
from support.wavefronts import bowl
from support.window_tools import LENSLETS, dim_frame

from app.measurement.measurement import Measurement
from app.results.replay import Comparison, are_alike
from app.results.run_summary import Measured


def rough(rms_rad: float) -> Measurement:
    """A frame whose views are columns of +rms and -rms, and 0 in the middle one."""
    views = np.zeros((3, 3, *LENSLETS))
    views[..., :6], views[..., 7:] = rms_rad, -rms_rad
    return make_measurement(dim_frame(), views)


def test_noise_of_a_frame_is_the_rms_of_its_sigma() -> None:
    frames = [replace(rough(1.0), wavefront=bowl(tilt)) for tilt in (0.0, 1000.0)]
    measured = Measured(bench=BENCH, means=np.zeros((3, 3, 3)))
    for frame in frames:
        assert measured.take(frame, "") is frame
    sigma = bowl().sigma()
    np.testing.assert_allclose(measured.noise_rad, np.sqrt(np.mean(sigma**2, axis=(2, 3))))


def test_scatter_is_the_standard_deviation_of_the_rms_of_the_frames() -> None:
    measured, share = Measured(bench=BENCH, means=np.zeros((3, 3, 3))), np.sqrt(12 / 13)  # of the columns
    for rms_rad in (1.0, 3.0):
        assert np.isnan(measured.scatter_rms_rad).all()
        measured.take(rough(rms_rad), "")
    np.testing.assert_allclose(measured.means[0], 2 * share)
    np.testing.assert_allclose(measured.scatter_rms_rad, np.sqrt(2) * share)


def test_comparison_has_the_means_over_its_frames() -> None:
    comparison, share = Comparison(), np.sqrt(12 / 13)  # of the columns
    for then, now in ((1.0, 3.0), (2.0, 5.0)):
        more = comparison.take(rough(then), rough(now))
        assert more["recorded_rms"][1] == pytest.approx(np.full((3, 3), then * share))
        assert more["difference_rms"][1] == pytest.approx(np.full((3, 3), (now - then) * share))
    for mean, expected in zip(comparison.means_rad, (1.5, 4.0, 2.5), strict=True):
        np.testing.assert_allclose(mean, expected * share)


def test_views_at_other_heights_are_not_alike() -> None:
    wavefront = bowl()
    column = replace(wavefront, views=wavefront.views[:, :1], field=replace(FIELD, view_columns=1))
    assert are_alike(column, column)
    assert not are_alike(column, replace(column, field=replace(column.field, view_spacing_m=0.4e-3)))

"""History of a running measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.gui_bench import make_measurement
from support.wavefronts import bowl

from app.results.history import DELAY, FILL, RMS, TEMPERATURE, History, drift, sample
from reconstruction.wavefront import rms


def test_series_share_one_time_axis_with_gaps() -> None:
    history = History()
    history.add(10.0, {"a": 1.0})
    history.add(10.5, {"a": 2.0, "b": 5.0})
    history.add(11.0, {"b": 6.0})
    for name, expected in (("a", [1, 2, np.nan]), ("b", [np.nan, 5, 6])):
        time_s, values = history.series(name)
        np.testing.assert_array_equal(time_s, [-1, -0.5, 0])
        np.testing.assert_array_equal(values, expected)
    assert history.series("c")[0].size == 0


def test_oldest_samples_give_way_and_memory_stays_bounded() -> None:
    history = History(capacity=100, most_series=3)
    for index in range(1000):
        history.add(float(index), {"a": float(index), f"pin {index // 10}": 0.0})
    assert history.series("pin 90")[0].size == 0
    time_s, values = history.series("pin 99")
    assert time_s.size == 100
    assert time_s[0] == -99
    assert np.isfinite(values).sum() == 10
    history.forget("pin 99")
    assert history.series("pin 99")[0].size == 0


def test_series_in_use_survives_many_others() -> None:
    history = History(capacity=100, most_series=3)
    for index in range(1000):
        history.add(float(index), {"a": float(index), f"pin {index // 10}": 0.0})
    np.testing.assert_array_equal(history.series("a")[1], np.arange(900, 1000))


def test_sample_of_a_frame() -> None:
    pixels = np.full((4, 5), 100, np.uint16)
    pixels[2, 3] = 3000
    wavefront = bowl()
    of_views = wavefront.views.copy()
    of_views[0, 0] = np.nan
    wavefront = replace(wavefront, views=of_views)
    measurement = replace(make_measurement(pixels, wavefront.views), latency_s=0.0123)
    time_s, found = sample(measurement, wavefront, full_scale=4000, temperature_c=-65.0)
    assert time_s == measurement.frame.host_time_s
    expected = np.nanmean([rms(view) for view in wavefront.views.reshape(9, *wavefront.views.shape[2:])[1:]])
    assert found == pytest.approx({RMS: expected, FILL: 75.0, DELAY: 12.3, TEMPERATURE: -65.0})
    assert sample(measurement, None, full_scale=0, temperature_c=None)[1] == {DELAY: 12.3}


def test_drift_is_that_of_the_known_values() -> None:
    assert drift(np.array([1.0, np.nan, 3.0, 5.0])) == pytest.approx((3, 2, 4))
    assert drift(np.array([1.0, np.nan])) == pytest.approx((1, np.nan, 0), nan_ok=True)
    assert np.isnan(drift(np.full(3, np.nan))).all()


def test_exported_table_holds_all_series_with_units_and_gaps() -> None:
    history = History(capacity=3)
    history.add(0.0, {"Z04": 9.0})
    history.add(10.0, {RMS: 1.5})
    history.add(10.5, {RMS: 2.0, DELAY: 4.0})
    history.add(11.0, {DELAY: 5.0})
    heads, rows = history.table()
    assert heads == ["time (s)", "Z04 (rad)", "RMS (rad)", "Delay (ms)"]
    np.testing.assert_array_equal(rows, [[0, np.nan, 1.5, np.nan], [0.5, np.nan, 2, 4], [1, np.nan, np.nan, 5]])

"""Writing and reading of a recording, also by the Zarr library."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from support.optics import SmallBench
from support.records import FACTS, RANDOM, SHAPE, make_record, make_records, noisy_calibration, write

from app.bench.config import write_bench
from app.errors import InputError
from app.measurement.averages import Average
from app.measurement.calibration import Calibration
from app.recording.reader import Recording
from app.recording.recover import recover
from app.recording.writer import RecordingWriter
from drivers.interface import Frame


@pytest.fixture(scope="module")
def calibration(small_bench: SmallBench) -> Calibration:
    return noisy_calibration(small_bench)


def test_written_recording_is_read_back(tmp_path: Path, calibration: Calibration) -> None:
    other, bias = replace(calibration), RANDOM.normal(size=(7, 9, 3, 2))
    first = make_record(50, calibration, lost=3)
    failed = make_record(51, calibration, displacement=None, coefficients=None, problem="too dark")
    second = make_record(52, calibration, bias=bias, bias_age_s=0.2)
    third = make_record(60, other, displacement=RANDOM.normal(size=(7, 9, 6, 2)), coefficients=None)
    records = [first, failed, second, third, make_record(61, light=None)]
    write(tmp_path / "r", records)

    recording = Recording(tmp_path / "r")
    assert (len(recording), recording.is_complete, recording.ended_early) == (5, True, "")
    assert recording.run["frames"] == {"acquired": 5, "recorded": 5, "reconstructed": 3, "lost": 3}
    assert recording.run["devices"] == FACTS["devices"]
    for index, record in enumerate(records):
        frame, line = recording.frame(index), recording.line(index)
        np.testing.assert_array_equal(frame.pixels, record.made.frame.pixels)
        assert frame.pixels.dtype == np.uint16
        for field in fields(Frame)[1:]:
            assert getattr(frame, field.name) == getattr(record.made.frame, field.name)
        assert (line.index, line.lost, line.problem) == (index, record.made.lost, record.made.problem)
        for found, expected in (
            (recording.displacement(index), record.displacement),
            (recording.coefficients(index), record.coefficients),
        ):
            assert (found is None) == (expected is None)
            if expected is not None:
                np.testing.assert_array_equal(found, expected)
    lines = [recording.line(index) for index in range(5)]
    assert [line.calibration for line in lines] == [0, 0, 0, 1, None]
    assert [line.bias for line in lines] == [None, None, 0, None, None]
    assert [line.is_light_on for line in lines] == [True] * 4 + [None]
    assert [recording.start(index) is None for index in (0, 3, 4)] == [True] * 3  # the first of their calibrations
    np.testing.assert_array_equal(recording.start(2), first.displacement)  # the second has none
    np.testing.assert_array_equal(recording.bias(0), bias)
    assert lines[0].rms_rad == first.rms_rad


def test_zarr_library_and_ome_readers_read_the_same(tmp_path: Path, calibration: Calibration) -> None:
    records = [*make_records(calibration, 9), make_record(9), make_record(10, calibration)]  # all in one chunk
    write(tmp_path / "growing", records, finish=False)
    growing = zarr.open_array(tmp_path / "growing" / "frames.zarr" / "0", mode="r").shape
    assert growing[0] > len(records)
    assert growing[1:] == SHAPE
    write(tmp_path / "r", records)
    group = zarr.open_group(tmp_path / "r" / "frames.zarr", mode="r")
    frames = group["0"]
    assert isinstance(frames, zarr.Array)
    assert frames.shape == (11, *SHAPE)
    assert frames.metadata.dimension_names == ("t", "y", "x")  # type: ignore[union-attr] # of Zarr v3
    np.testing.assert_array_equal(frames[:], [record.made.frame.pixels for record in records])
    coefficients = np.asarray(group["results/0/coefficients"])
    np.testing.assert_array_equal(coefficients[:9], [record.coefficients for record in records[:9]])
    np.testing.assert_array_equal(coefficients[10], records[10].coefficients)
    assert np.isnan(coefficients[9]).all()
    image: Any = group.attrs["ome"]
    assert image["version"] == "0.5"
    (scales,) = image["multiscales"]
    assert [axis["name"] for axis in scales["axes"]] == ["t", "y", "x"]
    assert scales["datasets"][0]["path"] == "0"


@pytest.mark.slow
@pytest.mark.long
def test_calibration_is_read_back_bit_for_bit(tmp_path: Path, calibration: Calibration) -> None:
    write(tmp_path / "r", [make_record(0, calibration)])
    found = Recording(tmp_path / "r").calibration(0)
    assert found.lattice == calibration.lattice
    assert write_bench(found.bench) == write_bench(replace(calibration.bench, lattice=calibration.lattice))
    assert found.full_scale == calibration.full_scale
    for kept, average in ((found.dark, calibration.dark), (found.reference, calibration.reference)):
        assert kept is not None
        assert average is not None
        for field in fields(Average):
            np.testing.assert_array_equal(getattr(kept, field.name), getattr(average, field.name))
        assert kept.mean.dtype == np.float32
    frame = np.asarray(calibration.reference.mean + 20, np.uint16)
    ours, theirs = calibration.reconstructor()(frame), found.reconstructor()(frame)
    np.testing.assert_array_equal(ours.views, theirs.views)


def test_growing_recording_can_be_read(tmp_path: Path, calibration: Calibration) -> None:
    records = make_records(calibration, 3)
    writer = RecordingWriter(tmp_path / "r", FACTS)
    recording = Recording(tmp_path / "r")
    assert (len(recording), recording.is_complete) == (0, False)
    for index, record in enumerate(records):
        writer.write(record)
        assert recording.refresh() == index + 1
        np.testing.assert_array_equal(recording.pixels(index), record.made.frame.pixels)
        np.testing.assert_array_equal(recording.coefficients(index), record.coefficients)
    with pytest.raises(InputError, match="still being recorded"):
        recover(tmp_path / "r")
    writer.finish("", acquired=3, facts={})
    writer.close()
    recording.refresh()
    assert recording.is_complete
    assert recover(tmp_path / "r").was_complete


def test_lines_are_standard_json(tmp_path: Path, calibration: Calibration) -> None:
    dark = make_record(0, calibration, rms_rad=math.nan)
    write(tmp_path / "r", [dark, make_record(1)])

    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    for line in (tmp_path / "r" / "frames.jsonl").read_text().splitlines():
        assert json.loads(line, parse_constant=refuse)["rms_rad"] is None

"""`svwfs mask`: unusable input in one sentence, and no file then. Drawings have tests in tests/app/masks."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from support.command_line import run

LONG = 513


@pytest.fixture(autouse=True)
def pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures that are no masks, in the working directory."""
    monkeypatch.chdir(tmp_path)
    np.save("empty.npy", np.zeros((5, 5)))
    np.save("grey.npy", np.arange(4.0).reshape(2, 2))
    np.save("never_dark.npy", np.array([[1.0, 2.0]]))
    np.save("long.npy", np.eye(LONG, 2))
    Path("text.png").write_text("no picture")
    Path("file").write_text("x")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("nonsense --out m.svg", "there is no mask and no file nonsense: give the file of a picture, or square, check"),
        ("peaks --out m.svg", "peaks is grey, and lithography makes openings only: choose square, checkerboard"),
        ("grey.npy --out m.svg", "grey.npy is grey (4 levels, the darkest 0), and lithography makes openings only"),
        ("never_dark.npy --out m.svg", "never_dark.npy is grey (2 levels, the darkest 1)"),
        ("empty.npy --out m.svg", "must hold finite brightness of 0 or more, and not all of it 0"),
        ("text.png --out m.svg", "file = 'text.png' is not a readable image: unknown format"),
        ("long.npy --out m.svg", "long.npy has more than 512 pixels along a side: make the picture smaller"),
        ("image --out m.svg", "the bench names no picture for the mask image: give the file itself"),
        ("square --size 0mm --out m.svg", "a mask of 0 mm cannot be drawn: choose a size from 2 um to 200 mm"),
        ("square --size=-1mm --out m.svg", "a mask of -1 mm cannot be drawn"),
        ("square --size 1.2 --out m.svg", "--size 1.2: give a length with its unit"),
        ("square --size 1e300m --out m.svg", "a mask of 1e+303 mm cannot be drawn"),
        ("square --size nan --out m.svg", "--size nan: give a length with its unit, as 1.2mm or 1200um"),
        ("square --size inf --out m.svg", "--size inf: give a length"),
        ("square --size 1.2inch --out m.svg", "--size 1.2inch: give a length"),
        ("square --out m.pdf", "m.pdf: give a drawing's name that ends in one of .svg, .dxf, .gds"),
        ("square --out m", "m: give a drawing's name that ends in one of"),
        ("square --out file/m.svg", "file: not a folder"),
        ("empty.npy --out empty.npy --overwrite", "empty.npy: is used by this command already"),
        ("stars --set simulation.source.pinhole_diameter_m=0.0 --out m.svg", "the pinholes of stars have no width"),
        ("stars --set simulation.source.star_spacing_m=50e-6 --out m.svg", "the pinholes of stars overlap"),
    ],
)
def test_unusable_input_is_one_sentence(
    words: str, sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    before = sorted(tmp_path.iterdir())
    assert run(monkeypatch, "mask", *words.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("svwfs: ")
    assert sentence in said
    assert said.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.posix
def test_pipe_is_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo("pipe")
    assert run(monkeypatch, "mask", "pipe", "--out", "m.svg") == 2
    assert capsys.readouterr().err == "svwfs: pipe: not a file\n"


def test_existing_file_is_replaced_only_if_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("m.svg").write_text("mine")
    assert run(monkeypatch, "mask", "square", "--out", "m.svg") == 2
    assert "m.svg: exists already; --overwrite replaces it" in capsys.readouterr().err
    assert Path("m.svg").read_text() == "mine"
    assert run(monkeypatch, "mask", "square", "--out", "m.svg", "--overwrite") == 0
    assert "<svg" in Path("m.svg").read_text()


@pytest.mark.parametrize(("suffix", "package"), [(".dxf", "ezdxf"), (".gds", "gdstk")])
def test_missing_extra_is_named(
    suffix: str, package: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for name in [name for name in sys.modules if name.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    before = sorted(tmp_path.iterdir())
    assert run(monkeypatch, "mask", "square", "--out", f"m{suffix}") == 2
    said = capsys.readouterr().err
    assert f"m{suffix}: this format needs {package}" in said
    assert "install the extra svwfs[mask], or write .svg\n" in said
    assert sorted(tmp_path.iterdir()) == before
    assert run(monkeypatch, "mask", "square", "--out", "m.svg") == 0


@pytest.mark.posix  # such names
def test_odd_names_of_pictures_spoil_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "a<&\x01\u00e4.npy"
    np.save(name, np.eye(3))
    for suffix in (".svg", ".dxf", ".gds"):
        assert run(monkeypatch, "mask", f"./{name}", "--out", f"m{suffix}") == 0
    assert "mask a&lt;&amp;??.npy, field 1.2 mm" in Path("m.svg").read_text()

"""Attempts to break the command line: cases as data, each a command and the damage done before it runs."""

from __future__ import annotations

import json
import math
import os
import pickle
import random
import shutil
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from app.bench.config import load_bench, write_bench
from app.images import read_image

Prepare = Callable[[Path], object]


@dataclass(frozen=True, slots=True)
class Attempt:
    """A command in a folder with `bench.toml`, `frame.tif`, `reference.tif`, `dark.tif` and the recording `run`."""

    command: tuple[str, ...]
    prepare: Prepare = lambda _: None
    damage: str = ""  # in words
    statuses: tuple[int, ...] = (0, 1, 2)

    def __str__(self) -> str:
        return f"{self.command!r} {self.damage}"


def attempts(rng: random.Random, keys: list[str]) -> Iterator[Attempt]:
    """Yield attempts without end, of all kinds in turn; `keys` are those of the bench."""
    kinds = (_settings(rng, keys), _images(rng), _recordings(rng), _run_facts(rng), _lines(rng), _arguments(rng))
    for kind in cycle(kinds):
        yield next(kind)


def bench_keys(bench: Path) -> list[str]:
    """All keys of a bench, as in --set."""

    def flat(tree: Mapping[str, Any], before: str = "") -> Iterator[str]:
        for key, value in tree.items():
            yield from flat(value, f"{before}{key}.") if isinstance(value, dict) else [before + key]

    return list(flat(tomllib.loads(write_bench(load_bench(bench)))))


RECONSTRUCT = [
    "reconstruct",
    "frame.tif",
    "--reference",
    "reference.tif",
    "--dark",
    "dark.tif",
    "--bench",
    "bench.toml",
    "--out",
    "out.nc",
]
CALIBRATE = ["calibrate", "reference.tif", "--dark", "dark.tif", "--bench", "bench.toml", "--out", "out.toml"]

_VALUES = (
    *("1e-40", "1e308", "5e-324", "-1", "0", "nan", "inf", "-inf", "1e300", "0.1", "1000", "2", "7", "10000000000"),
    *('"text"', "true", "[]", "{}", "[[[1]]]", "1979-05-27", "a=b", "", "'\\u001b[31m'", "5\nx=1", '"""', "[" * 3000),
)


def _settings(rng: random.Random, keys: list[str]) -> Iterator[Attempt]:
    """One setting of the bench is absurd."""
    while True:
        setting = f"{rng.choice(keys)}={rng.choice(_VALUES)}"
        yield Attempt((*rng.choice((RECONSTRUCT, CALIBRATE)), "--set", setting))


def _npy_header(shape: str, kind: str = "<f8") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00v\x00" + text


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _bytes(contents: bytes) -> Prepare:
    return lambda path: path.write_bytes(contents)


def _pixels(change: Callable[[NDArray[Any]], NDArray[Any]]) -> Prepare:
    return lambda path: tifffile.imwrite(path, change(read_image(path)), photometric="minisblack")


def _instead(make: Prepare) -> Prepare:
    """Put something else in the place of a file."""

    def put(path: Path) -> None:
        path.unlink()
        make(path)

    return put


def _bomb(path: Path) -> None:
    tifffile.imwrite(path, np.zeros((2**15, 2**14), np.uint8), compression="deflate")


_FILES: dict[str, Prepare] = {
    "missing": lambda path: path.unlink(),
    "empty": _bytes(b""),
    "cut in half": _cut,
    "garbage": _bytes(bytes(range(255, -1, -1)) * 20),
    "text": _bytes(b"no such thing\n"),
    "zeros": _bytes(bytes(4096)),
    "a folder": _instead(lambda path: path.mkdir()),
    "a pipe": _instead(os.mkfifo),
    "a link to itself": _instead(lambda path: path.symlink_to(path)),
    "a dangling link": _instead(lambda path: path.symlink_to("nowhere")),
    "a device": _instead(lambda path: path.symlink_to("/dev/zero")),
}
_IMAGES: dict[str, Prepare] = _FILES | {
    "not a number": _pixels(lambda image: np.where(image == image.max(), math.nan, image).astype(np.float32)),
    "infinite": _pixels(lambda image: np.where(image == image.max(), math.inf, image).astype(np.float32)),
    "all nan": _pixels(lambda image: np.full(image.shape, math.nan)),
    "huge values": _pixels(lambda image: image * 1e300),
    "tiny values": _pixels(lambda image: image * 1e-300),
    "negative": _pixels(lambda image: -image.astype(np.float64)),
    "saturated": _pixels(lambda image: np.full(image.shape, 65535, np.uint16)),
    "dark": _pixels(np.zeros_like),
    "constant": _pixels(lambda image: np.full(image.shape, 1000, np.uint16)),
    "noise": _pixels(lambda image: np.random.default_rng(0).integers(0, 65536, image.shape).astype(np.uint16)),
    "8 bits": _pixels(lambda image: (image >> 8).astype(np.uint8)),
    "signed": _pixels(lambda image: (image >> 1).astype(np.int16)),
    "truth values": _pixels(lambda image: image > image.mean()),
    "half precision": _pixels(lambda image: (image / 8).astype(np.float16)),
    "64 bits": _pixels(lambda image: image.astype(np.int64)),
    "other size": _pixels(lambda image: image[:-3, :-5]),
    "turned": _pixels(lambda image: np.ascontiguousarray(image.T)),
    "one pixel": _pixels(lambda image: image[:1, :1]),
    "one row": _pixels(lambda image: image[:1]),
    "a stack": _pixels(lambda image: np.stack([image] * 3)),
    "a deflated bomb": _bomb,
}
_ARRAYS: dict[str, bytes] = {
    "pickled": b"\x93NUMPY\x01\x00v\x00" + _npy_header("(2, 2)", "|O")[10:] + pickle.dumps([0, 0, 0, 0]),
    "garbage": b"no array at all",
    "too short": _npy_header("(172, 240)") + bytes(100),
    "a bomb": _npy_header("(999999, 999999)") + bytes(100),
    "negative shape": _npy_header("(-3, 5)") + bytes(100),
    "no shape": _npy_header("()") + bytes(8),
    "complex": _npy_header("(2, 2)", "<c16") + bytes(64),
    "strings": _npy_header("(2, 2)", "<U4") + bytes(64),
    "records": _npy_header("(2, 2)", "|V8") + bytes(64),
    "empty": b"\x93NUMPY",
    "code": _npy_header("__import__('os').abort()"),
}


def _images(rng: random.Random) -> Iterator[Attempt]:
    """An image file is damaged, or holds what no camera gives."""
    while True:
        role = rng.choice(("frame", "reference", "dark"))
        command = rng.choice((RECONSTRUCT, CALIBRATE)) if role != "frame" else RECONSTRUCT
        if rng.random() < 0.3:
            name = rng.choice(list(_ARRAYS))
            words = tuple(word.replace(f"{role}.tif", f"{role}.npy") for word in command)
            yield Attempt(words, partial(_write, f"{role}.npy", _bytes(_ARRAYS[name])), f"{role}: {name}", (2,))
        else:
            name = rng.choice(list(_IMAGES))
            statuses = (2,) if name in _FILES else (0, 1, 2)
            yield Attempt(tuple(command), partial(_write, f"{role}.tif", _IMAGES[name]), f"{role}: {name}", statuses)


def _write(name: str, make: Prepare, folder: Path) -> None:
    make(folder / name)


_PARTS = (
    *("run.json", "frames.jsonl", "start.npy", "frames.zarr/zarr.json", "frames.zarr/0/zarr.json"),
    *("frames.zarr/0/c/1/0/0", "frames.zarr/results/0/displacement/zarr.json"),
    *("frames.zarr/results/0/displacement/c.1.0.0.0.0", "calibrations/0/bench.toml", "calibrations/0/camera.json"),
    *("calibrations/0/reference.npz", "calibrations/0/dark.npz"),
)
_OF_RECORDINGS = (
    *("recover run", "replay run", "replay run --verify", "replay run --out out.nc", "replay run --frames 1:3"),
    *("export run --to csv --out out", "export run --to tiff --out out", "export run --to netcdf --out out"),
    *("replay run --set reconstruction.method=zonal", "recover run", "export run --to psf --out out"),
    *("export run --to double-zernike --out out", "export run --to zernike-table --out out", "field run --out out.nc"),
)
_JSON: tuple[Any, ...] = (
    None,
    0,
    -1,
    10**9,
    10**30,
    1e308,
    "text",
    "",
    [],
    {},
    [[]],
    True,
    "\x1b[31m",
    "$\\frac",
    "x" * 10_000,
)


def _command(rng: random.Random) -> tuple[str, ...]:
    return tuple((rng.choice(_OF_RECORDINGS) if rng.random() > 0.03 else "report run --out out.pdf").split())


def _recordings(rng: random.Random) -> Iterator[Attempt]:
    """A file of a recording is damaged."""
    while True:
        part, name = rng.choice(_PARTS), rng.choice(list(_FILES))
        yield Attempt(_command(rng), partial(_damage, part, _FILES[name]), f"{part}: {name}")


def _damage(part: str, make: Prepare, folder: Path) -> None:
    path = folder / "run" / part
    if not path.exists():
        path.touch()
    make(path)


def _run_facts(rng: random.Random) -> Iterator[Attempt]:
    """A fact in `run.json` or in a calibration's `camera.json` is another."""
    keys = ("format", "complete", "bench", "began", "ended", "ended_early", "devices", "frames", "timings", "versions")
    while True:
        key, value = rng.choice(keys), rng.choice(_JSON)
        file = "run.json" if rng.random() > 0.1 else "calibrations/0/camera.json"
        key = key if file == "run.json" else "full_scale"
        yield Attempt(_command(rng), partial(_edit_json, file, {key: value}), f"{file}: {key} = {str(value)[:40]!r}")


def _edit_json(file: str, changes: Mapping[str, Any], folder: Path) -> None:
    path = folder / "run" / file
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


_FIELDS = (
    *("index", "camera_index", "camera_time_s", "host_time_s", "exposure_s", "em_gain", "is_light_on", "lost"),
    *("calibration", "bias", "bias_age_s", "start", "problem", "rms_rad", "valid"),
)


def _lines(rng: random.Random) -> Iterator[Attempt]:
    """A line of a frame says something else, or is not in its place."""
    while True:
        key, value = rng.choice(_FIELDS), rng.choice((*_JSON, math.nan, 2, 1, -2))
        yield Attempt(
            _command(rng), partial(_edit_line, rng.randrange(4), {key: value}), f"line: {key} = {str(value)[:40]!r}"
        )


def _edit_line(index: int, changes: Mapping[str, Any], folder: Path) -> None:
    path = folder / "run" / "frames.jsonl"
    lines = path.read_text().splitlines()
    lines[index] = json.dumps({**json.loads(lines[index]), **changes})
    path.write_text("".join(f"{line}\n" for line in lines))


_ODD_NAMES: tuple[str, ...] = (
    "n" * 300,
    "no/such/folder/\x1b[31mx",
    "\udcff.tif",
    ".",
    "..",
    "/",
    "/dev/null",
    "frame.tif/x",
    "a\nb",
    "",
)
_ODD_NAMES += ("-", "[red]x[/blue]", "run", "run/run.json", "bench.toml")
_ODD_FRAMES = ("a", "1", "5:2", "::", "1:2:3", "-1:", "99:", "1e3:", "0:9" + "9" * 5000, "", "\x1b[31m", "٣:٤")
_ODD_BENCHES = (
    "nowhere",
    "nowhere.toml",
    "live_demo2",
    "frame.tif",
    "run",
    ".",
    "",
    "a\0b",
    "n" * 300,
    "\udcff",
    "dark.tif/x",
)
_SUFFIXES = ("pgf", "ps", "eps", "jpg", "raw", "svgz", "txt", "", "png.exe", "PNG", "webp", "gif")


def _arguments(rng: random.Random) -> Iterator[Attempt]:
    """An argument is odd."""

    def with_last(command: list[str], word: str) -> tuple[str, ...]:
        return (*command[:-1], word)

    while True:
        yield from (
            Attempt(with_last(rng.choice((RECONSTRUCT, CALIBRATE)), rng.choice(_ODD_NAMES))),
            Attempt((*RECONSTRUCT, "--plot", rng.choice(_ODD_NAMES))),
            Attempt((*rng.choice((RECONSTRUCT, CALIBRATE)), "--plot", f"p.{rng.choice(_SUFFIXES)}")),
            Attempt(("replay", "run", "--frames", rng.choice(_ODD_FRAMES))),
            Attempt((*CALIBRATE[:-4], "--bench", rng.choice(_ODD_BENCHES)), statuses=(2,)),
            Attempt((*CALIBRATE, "--set", rng.choice(_VALUES)), statuses=(2,)),
            Attempt((rng.choice(("recover", "replay")), rng.choice(_ODD_NAMES)), statuses=(0, 1, 2)),
            Attempt(("calibrate", rng.choice(_ODD_NAMES), *CALIBRATE[2:]), statuses=(2,)),
            Attempt(("simulate", "--bench", "bench.toml", "--out", rng.choice(_ODD_NAMES[:-3]))),
            Attempt(("export", "run", "--to", rng.choice(("csv", "pdf")), "--out", rng.choice(_ODD_NAMES))),
            Attempt(
                tuple(rng.choice(("live --frames 1:2", "devices --check x", "devices --bench x", "nonsense")).split())
            ),
            Attempt(CALIBRATE_DEEP, _deep_bench, "a bench nested 20,000 deep", (2,)),
        )


CALIBRATE_DEEP = (*CALIBRATE[:-4], "--bench", "deep.toml")


def _deep_bench(folder: Path) -> None:
    (folder / "deep.toml").write_text("x = " + "[" * 20_000 + "]" * 20_000)


def make_folder(prepared: Path, folder: Path) -> None:
    """Fill a folder for an attempt."""
    shutil.copytree(prepared, folder, dirs_exist_ok=True)


def some(count: int, seed: int, keys: list[str]) -> Iterator[Attempt]:
    """Yield so many attempts."""
    return islice(attempts(random.Random(seed), keys), count)  # noqa: S311 - no secret

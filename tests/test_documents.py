"""README and documentation: they build without a warning, links lead somewhere, commands and programs run."""

from __future__ import annotations

import dataclasses
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, nullcontext
from functools import reduce
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
import typer.main
from packaging.version import Version
from support.batches import Counting, batch
from support.command_line import run
from support.gui_bench import FakeCamera
from support.optics import SmallBench
from support.paths import DOCS, FOREIGN_FRAMES, ROOT, SMALL_TOML
from support.patience import HANG_S
from support.recordings import record
from support.served import served

import svwfs
from app.bench.config import Bench
from app.bench.device_kinds import DRIVERS
from app.bench.presets import PRESETS
from app.cli.application import cli
from reconstruction.registration import prepare_registration
from reconstruction.settings import RegistrationSettings


def python_blocks(path: Path) -> str:
    """Return the Python blocks of a document as one program, without those that need hardware or have a test."""
    blocks = r"(?<!<!-- needs hardware -->\n)(?<!<!-- tested apart -->\n)^```python\n(.*?)^```"
    return "\n".join(re.findall(blocks, path.read_text("utf-8"), re.DOTALL | re.MULTILINE))


def commands(path: Path) -> list[str]:
    """Return the commands of a document, one line each, without `svwfs` and comments."""
    joined = path.read_text("utf-8").replace("\\\n", " ")
    found = re.findall(r"^    svwfs ((?:(?!  +# ).)+)", joined, re.MULTILINE)
    return [" ".join(command.split()) for command in found]


def named_commands(path: Path) -> list[str]:
    """Return the commands that sentences and tables name, without `svwfs`."""
    return re.findall(r"`svwfs ([^`]+)`", path.read_text("utf-8").replace("\n", " "))


DOCUMENTS = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
# One has a test of its own, on a bench like its own.
COMMANDS = [path for path in DOCUMENTS if commands(path) and path.name != "first_measurement.md"]
PROGRAMS = [path for path in DOCUMENTS if python_blocks(path)]
QUICK = {
    "--attach --frames 100": "--attach --frames 4",
    "--frames 20": "--frames 2",
    "0:10": "0:2",
    "100:200": "0:2",
    "--refine 3": "--refine 1",
    "FILE...": "four_holes.npy",
}
BENCH = f"{SMALL_TOML}\n[imaging]\npixel_m = 10e-6\n"


def build(source: Path, out: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", f"{out}.cache", str(source), str(out)]
    return subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=False)  # noqa: S603 - our own


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The documentation as web pages."""
    out = tmp_path_factory.mktemp("docs") / "pages"
    told = build(DOCS, out)
    assert (told.returncode, told.stderr) == (0, "")
    return out


def text_of(page: Path) -> str:
    return re.sub(r"<[^>]+>", "", page.read_text("utf-8")).replace("&quot;", '"')


@pytest.mark.slow
def test_pages_need_no_network_and_can_be_searched(pages: Path) -> None:
    assert (pages / "searchindex.js").stat().st_size > 10_000
    loading = re.compile(
        r"""<(?:script|img|link)[^>]+(?:src|href)=["']?(?:https?:)?//|@import|url\(["']?(?:https?:)?//"""
    )
    files = [path for kind in ("*.html", "*.css", "*.js") for path in pages.rglob(kind)]
    assert len(files) > 30
    assert not [path.name for path in files if loading.search(path.read_text("utf-8"))]


def names_of(cls: Any) -> Iterator[str]:
    """Names of all settings of a class, also of its parts."""
    for name, part in get_type_hints(cls).items():
        yield from names_of(part) if dataclasses.is_dataclass(part) else (name,)


@pytest.mark.slow
def test_bench_reference_has_every_setting(pages: Path) -> None:
    text = text_of(pages / "bench.html")
    for section, hint in get_type_hints(Bench).items():
        assert f"[{section}]" in text
        drivers = [kind.settings for kind in DRIVERS.get(section, {}).values()]
        kinds = drivers or [cls for cls in get_args(hint) or (hint,) if dataclasses.is_dataclass(cls)]
        names = {name for cls in kinds for name in names_of(cls)} - {"driver"}
        assert names
        assert not {name for name in names if not re.search(rf"^{name}$", text, re.MULTILINE)}
    assert 'driver = "thorlabs_dc4100"' in text
    assert re.search(
        r"^exposure_s\ns\n0.014\d+\nExposure; range by amplifier and speed. Must be 0.0001 ... 7200$",
        text,
        re.MULTILINE,
    )
    assert re.search(r"^lenslet_rows\n\nomitted\n.*Must be 2 ... 1000$", text, re.MULTILINE)


@pytest.mark.slow
def test_references_have_every_command_and_name(pages: Path) -> None:
    text = text_of(pages / "commands.html")
    for command in ("live", "deconvolve", "paper", "desktop"):
        assert f"Usage: svwfs {command} [OPTIONS]" in text
    text = text_of(pages / "api.html")
    assert not [
        name for name in svwfs.__all__ if not re.search(rf"^(?:class |exception )?{name}\b", text, re.MULTILINE)
    ]


@pytest.mark.slow
def test_broken_links_fail(tmp_path: Path) -> None:
    shutil.copy(DOCS / "conf.py", tmp_path)
    shutil.copytree(DOCS / "_static", tmp_path / "_static")
    (tmp_path / "index.md").write_text("# A\n\n[a](b.md) [c](#d) ![e](f.png) [g](../h.json)\n")
    told = build(tmp_path, tmp_path / "out")
    assert told.returncode != 0
    assert all(name in told.stderr for name in ("b.md", "'d'", "f.png", "h.json"))


def test_version_is_that_of_the_changelog() -> None:
    heading = (ROOT / "CHANGELOG.md").read_text("utf-8").partition("\n## ")[2].partition("\n")[0]
    version = Version(tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"])
    release, _, state = heading.partition(" - ")
    assert Version(release).release == version.release[: release.count(".") + 1]
    assert version.is_devrelease == (state == "unreleased")
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text("utf-8")


@pytest.mark.parametrize("name", ["README.md", "CHANGELOG.md"])
def test_links_of_readme_and_changelog_exist(name: str) -> None:
    links = re.findall(r"\]\(([^)#:]+)\)", (ROOT / name).read_text("utf-8"))
    assert len(links) > 5
    assert not [link for link in links if not (ROOT / link).exists()]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files that the documents name: benches, images, results, masks and a recording."""
    folder = tmp_path_factory.mktemp("inputs")
    for name in ("bench.toml", "other.toml"):
        (folder / name).write_text(BENCH)
    record(folder / "bench.toml", folder / "RUN", frames=3)
    shutil.copytree(FOREIGN_FRAMES, folder / "FRAMES")
    np.save(folder / "four_holes.npy", np.eye(40, dtype=np.float32))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert run(patch, "simulate", "--bench", "bench.toml", "--out", ".") == 0
        files = ("--reference", "reference.tif", "--dark", "dark.tif", "--bench", "bench.toml", "--out", "RESULT")
        assert run(patch, "reconstruct", "frame.tif", *files) == 0
    shutil.copy(folder / "frame.tif", folder / "IMAGE")
    batch(folder / "results.zarr", folder / "RUN")
    return folder


@pytest.fixture
def at_work(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with the inputs."""
    shutil.copytree(inputs, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.usefixtures("runtime_folder")
@pytest.mark.parametrize("document", COMMANDS, ids=lambda path: path.stem)
def test_commands_run(document: Path, at_work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in PRESETS:
        monkeypatch.setitem(PRESETS, name, at_work / "bench.toml")
    monkeypatch.setattr("app.evaluation.paper.compare", lambda *_, **_options: None)  # it has tests of its own
    monkeypatch.setattr("app.evaluation.paper.write_table", lambda *_: None)
    monkeypatch.setattr("app.evaluation.paper.printed", lambda *_: ("", ["method"], [], []))
    monkeypatch.setattr("app.evaluation.mask_accuracy.predicted_accuracies", lambda *_: {"square": {}})
    monkeypatch.setattr("app.batch.workers.workers", lambda *_, **_options: nullcontext(Counting()))
    instrument = ExitStack()
    for command in commands(document):
        quick = reduce(lambda text, change: text.replace(*change), QUICK.items(), command)
        words = shlex.split(quick.partition(" > ")[0])  # the shell's
        if words[0] == "live":
            words += ["--seconds", "0.1"]
        if words[0] in {"deconvolve", "layers", "live", "paper"}:  # a document writes the same file again and again
            words += ["--overwrite"]
        if words[0] == "serve":  # until it is asked to end
            instrument.enter_context(served(FakeCamera()))
        else:
            assert run(monkeypatch, *words) == 0, command
    instrument.close()


@pytest.mark.slow
@pytest.mark.usefixtures("at_work", "runtime_folder")
@pytest.mark.parametrize("document", PROGRAMS, ids=lambda path: path.stem)
def test_programs_run(document: Path) -> None:
    with served(FakeCamera()) if document.stem == "sharing" else nullcontext():
        exec(compile(python_blocks(document), document.name, "exec"), {})  # noqa: S102 - our own document


@pytest.mark.slow
def test_methods_of_the_documents_can_be_made_part_of_svwfs(small_bench: SmallBench) -> None:
    names: dict[str, Any] = {}
    exec(compile(python_blocks(DOCS / "extending.md"), "extending", "exec"), names)  # noqa: S102 - our own document
    module = SimpleNamespace(prepare=names["prepare"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("reconstruction.registration.import_module", lambda _: module)
        settings = RegistrationSettings()
        made = prepare_registration(small_bench.subimages(), settings, small_bench.field)
    assert isinstance(made, names["CentreOfMass"])
    names["test_tilt_is_recovered"](small_bench)


@pytest.mark.parametrize("document", [path for path in DOCUMENTS if named_commands(path)], ids=lambda path: path.stem)
def test_named_commands_and_options_exist(document: Path) -> None:
    known: Any = typer.main.get_command(cli)
    context = known.make_context("svwfs", [], resilient_parsing=True)
    for text in named_commands(document):
        words = [word.rstrip(",;:") for word in text.split()]
        is_known = words[0].startswith("-") or words[0] in known.commands
        assert is_known or text in {"COMMAND --help", "recording 1"}, text  # one is the format of recordings
        command = known.resolve_command(context, words[:1])[1] if words[0] in known.commands else known
        options = {option for each in command.params for option in each.opts} | {"--help"}
        assert {word.strip("[]") for word in words if word.strip("[").startswith("--")} <= options, text


DEVICE_HEADINGS = (
    *(
        "Models, and what was really tried",
        "Install",
        "Find it",
        "Smallest bench section",
        "All settings",
        "First check",
    ),
    *("What the driver changes when it opens", "Limits", "Messages and what to do"),
)


@pytest.mark.parametrize("page", sorted(DOCS.glob("devices_*.md")), ids=lambda path: path.stem)
def test_device_pages_have_the_same_headings(page: Path) -> None:
    text = page.read_text("utf-8")
    found = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert [heading for heading in found if heading in DEVICE_HEADINGS] == list(DEVICE_HEADINGS)
    drivers = re.findall(r"<!-- settings (\w+) (\w+) -->", text)
    assert drivers
    assert all(driver in DRIVERS[section] for section, driver in drivers)


def test_every_real_driver_has_a_page() -> None:
    told = "\n".join(page.read_text("utf-8") for page in DOCS.glob("devices_*.md"))
    drivers = {driver for section in DRIVERS.values() for driver in section} - {"simulated"}
    assert not {driver for driver in drivers if f"`{driver}`" not in told and f'driver = "{driver}"' not in told}


def test_pages_stay_few_and_the_readme_short() -> None:
    pages = {path.stem for path in DOCS.glob("*.md")} - {"api", "bench", "commands"}  # these are generated
    assert len(pages) <= 25
    readme = (ROOT / "README.md").read_text("utf-8")
    assert len(readme.splitlines()) <= 120
    before, _, _ = readme.partition("\n    ")  # the first command
    assert len(before.split()) <= 90

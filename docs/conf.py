"""Sphinx settings of the documentation, and the pages that are made from the program itself."""

import inspect
import json
import re
from collections.abc import Iterator
from dataclasses import MISSING, is_dataclass
from importlib.metadata import version as version_of
from types import SimpleNamespace
from typing import Literal, get_args, get_origin

import typer.main
from sphinx.application import Sphinx

import svwfs
from app.bench.config import Bench
from app.bench.device_kinds import DRIVERS
from app.bench.settings_form import unit_of
from app.cli.application import cli
from reconstruction.annotated_settings import Limit, Setting, settings_of

project = "svwfs"
author = "the authors of svwfs"
version = release = version_of("svwfs")
project_copyright = "the authors of svwfs, GPL-3.0-or-later"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 3  # links to headings are those of the same page elsewhere
smartquotes = False  # they would change code
default_role = "code"  # docstrings have single backticks
add_module_names = False
highlight_language = "none"  # of indented blocks; fenced ones name theirs

html_theme = "alabaster"
html_static_path = ["_static"]
html_theme_options = {
    "description": "Wavefronts at every position of the field, live",
    "page_width": "1120px",
    "sidebar_width": "250px",
    "body_max_width": "none",
    "fixed_sidebar": True,
    "show_relbars": True,
    "font_family": "system-ui, sans-serif",
    "head_font_family": "system-ui, sans-serif",
    "code_font_size": "0.82em",
}
html_sidebars = {"**": ["about.html", "searchfield.html", "navigation.html"]}
html_show_sourcelink = False
html_show_sphinx = False


def setup(sphinx: Sphinx) -> None:
    """Append what the program knows of itself to the pages that introduce it."""
    sphinx.connect("source-read", _append)
    sphinx.connect("autodoc-process-signature", _without_arguments)


def _append(_sphinx: Sphinx, page: str, source: list[str]) -> None:
    if page in _MADE:
        source[0] = "\n".join([source[0], *_MADE[page]()])


def _commands() -> Iterator[str]:
    """Return the help of every command."""
    group = typer.main.get_command(cli)
    context = group.make_context("svwfs", [], resilient_parsing=True)
    for name in group.list_commands(context):
        command = group.resolve_command(context, [name])[1]  # imported
        own = command.context_class(command, context, name, max_content_width=110, terminal_width=110)
        yield f"## svwfs {name}\n\n```text\n{command.get_help(own)}\n```\n"


def _names() -> Iterator[str]:
    """Return the names that `svwfs` exports: functions, classes and errors."""
    kinds = {"function": [], "class": [], "exception": []}
    for name in svwfs.__all__:
        one = getattr(svwfs, name)
        kind = "function" if not isinstance(one, type) else "exception" if issubclass(one, BaseException) else "class"
        kinds[kind].append(name)
    for title, (kind, names) in zip(("Functions", "Classes", "Errors"), kinds.items(), strict=True):
        members = "\n   :members:" if kind == "class" else ""
        yield f"## {title}\n\n```{{eval-rst}}"
        yield from (f".. auto{kind}:: svwfs.{name}{members}\n" for name in names)
        yield "```\n"


def _without_arguments(_sphinx: Sphinx, kind: str, *facts: object) -> tuple[str, str] | None:
    """Hide the arguments of classes, which functions make."""
    return ("", "") if kind in {"class", "exception"} and facts[-2] else None


def _settings() -> Iterator[str]:
    """Return every section of a bench as a table; camera and light once for each driver."""
    for section in settings_of(Bench):
        if section.name not in DRIVERS:
            yield from _tables(section.name, section.kind, f"## `[{section.name}]`")
        for driver, kind in DRIVERS.get(section.name, {}).items():
            yield from _tables(section.name, kind.settings, f'## `[{section.name}]` with `driver = "{driver}"`')


def _tables(path: str, cls: type, title: str) -> Iterator[str]:
    """Return the table of a settings class, and those of its parts."""
    settings = [one for one in settings_of(cls) if not one.section and one.name != "driver"]
    parts = [one for one in settings if is_dataclass(one.kind) and not one.is_optional]
    usual = SimpleNamespace(**{one.name: one.default for one in settings})
    rows = [_cells(one, one.limit(usual)) for one in settings if one not in parts]
    head = [("setting", "unit", "default", "is"), ("---",) * 4] if rows else []
    yield f"{title}\n\n{inspect.getdoc(cls).splitlines()[0]}\n"
    yield from ("| " + " | ".join(cells) + " |" for cells in head + rows)
    yield ""
    for one in parts:
        yield from _tables(f"{path}.{one.name}", one.kind, f"### `[{path}.{one.name}]`")


def _cells(setting: Setting, limit: Limit | None) -> tuple[str, str, str, str]:
    if get_origin(setting.kind) is Literal:
        allowed = ", ".join(f"`{choice}`" for choice in get_args(setting.kind) if choice)
    else:
        allowed = "" if limit is None else limit.words().capitalize().replace("Must be finite", "")
    meaning = ". ".join(filter(None, (re.sub(r"([|*<])", r"\\\1", setting.help), allowed)))
    return f"`{setting.name}`", unit_of(setting.name)[1], _default(setting), meaning


def _default(setting: Setting) -> str:
    if setting.default is MISSING:
        return "**required**"
    if setting.default is None or setting.default == "":
        return "omitted"
    return f"`{json.dumps(setting.default)}`"  # which is TOML, too


_MADE = {"api": _names, "bench": _settings, "commands": _commands}

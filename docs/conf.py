"""Sphinx settings of the documentation, and the pages that are made from the program itself."""

import json
import re
from collections.abc import Iterator
from importlib.metadata import version as version_of

import typer.main
from sphinx.application import Sphinx

import svwfs
from app.bench.config import bench_schema
from app.bench.settings_schema import allowed, unit_of
from app.cli.application import cli

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
    """Add to the pages what the program knows of itself."""
    sphinx.connect("source-read", _append)
    sphinx.connect("autodoc-process-signature", _without_arguments)


def _append(_sphinx: Sphinx, page: str, source: list[str]) -> None:
    if page in _MADE:
        source[0] = "\n".join([source[0], *_MADE[page]()])
    source[0] = re.sub(r"<!-- settings (\w+) (\w+) -->", lambda found: "\n".join(_driver(*found.groups())), source[0])


def _driver(section: str, driver: str) -> Iterator[str]:
    """Return the settings of one driver of `camera` or `light` as a table."""
    kinds = bench_schema()["properties"][section]["oneOf"]
    kind = next(each for each in kinds if each["properties"]["driver"]["const"] == driver)
    yield from _tables(section, kind, f'`driver = "{driver}"`:')


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
    for name, section in bench_schema()["properties"].items():
        if "oneOf" not in section:
            yield from _tables(name, section, f"## `[{name}]`")
        for each in section.get("oneOf", ()):
            driver = each["properties"]["driver"]["const"]
            yield from _tables(name, each, f'## `[{name}]` with `driver = "{driver}"`')


def _tables(path, schema, title) -> Iterator[str]:
    """Return the table of a section, and those of its parts."""
    settings = {name: each for name, each in schema["properties"].items() if name != "driver"}
    parts = [name for name, each in settings.items() if "properties" in each and "required" not in each]
    rows = [_cells(name, each, schema) for name, each in settings.items() if name not in parts]
    head = [("setting", "unit", "default", "is"), ("---",) * 4] if rows else []
    yield f"{title}\n\n{schema['description']}\n"
    yield from ("| " + " | ".join(cells) + " |" for cells in head + rows)
    yield ""
    for name in parts:
        yield from _tables(f"{path}.{name}", settings[name], f"### `[{path}.{name}]`")


def _cells(name, setting, section) -> tuple[str, str, str, str]:
    choices = ", ".join(f"`{choice}`" for choice in setting.get("enum", ()) if choice)
    meaning = re.sub(r"([|*<])", r"\\\1", setting.get("description", ""))
    text = ". ".join(filter(None, (meaning, choices or allowed(setting).capitalize())))
    return f"`{name}`", unit_of(name)[1], _default(name, setting, section), text


def _default(name, setting, section) -> str:
    if name in section.get("required", ()):
        return "**required**"
    default = setting.get("default", "")
    return "omitted" if default == "" else f"`{json.dumps(default)}`"  # which is TOML, too


_MADE = {"api": _names, "bench": _settings, "commands": _commands}

"""Sphinx settings of the documentation, and the pages that are made from the program itself."""

import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import version as version_of
from typing import get_type_hints

import typer.main
from sphinx.application import Sphinx

import svwfs
from app.bench.config import Bench
from app.bench.device_settings import CameraSettings, LightSettings, drivers_of
from app.bench.presets import PRESETS
from app.bench.settings_form import FormField, SettingsForm
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
        command = group.get_command(context, name)
        yield f"## svwfs {name}\n"
        yield from _help(command, context, name)
        for part in getattr(command, "commands", {}):
            yield f"### svwfs {name} {part}\n"
            yield from _help(command.commands[part], command.context_class(command, context, name), part)


def _help(command, parent, name) -> Iterator[str]:
    context = command.context_class(command, parent, name, max_content_width=110, terminal_width=110)
    yield f"```text\n{command.get_help(context)}\n```\n"


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
    unions = {"camera": CameraSettings, "light": LightSettings}
    preset = tomllib.loads(PRESETS["small_demo"].read_text("utf-8"))
    required = {name: preset[name] for name in ("sensor", "field")}
    for name in get_type_hints(Bench):
        if name not in unions:
            yield from _tables(name, {}, required, f"`[{name}]`")
            continue
        for driver in drivers_of(unions[name]):
            chosen = {name: {"driver": driver}}
            yield from _tables(name, chosen, chosen, f'`[{name}]` with `driver = "{driver}"`')


def _tables(name: str, chosen: dict, required: dict, title: str) -> Iterator[str]:
    """Return the sections of a setting's class; their limits are known if `required` has what has no default."""
    empty = SettingsForm(chosen).sections()
    texts = {
        field.path.split(".")[1]: "text"
        for section in empty
        for field in section.fields
        if section.path == name and field.kind == "text" and not field.is_optional
    }
    filled = SettingsForm({**required, name: {**required.get(name, {}), **texts}})
    for section, limits in zip(empty, filled.sections(), strict=True):
        if section.path == name:
            yield f"## {title}\n"
        elif section.path.startswith(f"{name}."):
            yield f"### `[{section.path}]`\n"
        else:
            continue
        pairs = zip(section.fields, limits.fields, strict=True)
        rows = [_cells(field, limited.help) for field, limited in pairs if not field.path.endswith(".driver")]
        head = [("setting", "unit", "default", "is"), ("---",) * 4] if rows else []
        yield f"{section.help}\n"
        yield from ("| " + " | ".join(cells) + " |" for cells in head + rows)
        yield ""


def _cells(field: FormField, meaning: str) -> tuple[str, str, str, str]:
    unit = field.unit[1:] if field.factor != 1 else field.unit  # a bench file has SI units without prefixes
    meaning = meaning.replace("None", "omitted")
    if meaning.partition(" ")[0][1:].islower():
        meaning = meaning[:1].lower() + meaning[1:]  # it begins a sentence in the form
    choices = ", ".join(f"`{choice}`" for choice in field.choices if choice)
    meaning = ". ".join(filter(None, (re.sub(r"([|*<])", r"\\\1", meaning), choices)))
    return f"`{field.path.rpartition('.')[2]}`", unit, _default(field), meaning


def _default(field: FormField) -> str:
    value = field.parse(field.text) if field.text else None
    if value is None:
        return "omitted" if field.is_optional or "" in field.choices else "**required**"
    return f"`{field.text}`" if field.kind in {"toml", "switch"} else f"`{value!r}`".replace("'", '"')


_MADE = {"api": _names, "bench": _settings, "commands": _commands}

"""Limits and errors of settings in the labels and units of their form."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from app.bench.config import Bench
    from app.bench.settings_form import FormField

_NUMBER = re.compile(r"(?<![\w.*+-])[+-]?\d+\.?\d*(?:e[+-]?\d+)?(?![\w.*]| ?pixel)")


def in_unit(limits: str, unit: str, factor: float) -> str:
    """Convert the numbers of limits from SI units, and add the unit after the last; numbers of pixels stay."""
    numbers = list(_NUMBER.finditer(limits)) if unit else []
    for found in reversed(numbers):
        text = f"{float(found[0]) / factor:.10g}" + (f" {unit}" if found is numbers[-1] else "")
        limits = limits[: found.start()] + text + limits[found.end() :]
    return limits


def in_words(sentence: str, faulty: str, fields: Mapping[str, FormField]) -> str:
    """Return an error of a form's bench with labels and units in place of keys and SI units.

    `faulty` is the path of the setting that it names; `fields` are the fields by path, as they are shown.
    """
    sentence, (section, _, key) = sentence.removeprefix("the settings: "), faulty.rpartition(".")
    if faulty in fields:
        field = fields[faulty]
        found = re.match(rf"({re.escape(section)}: {key}|{re.escape(faulty)}:?) (?!=)", sentence)
        if found is not None:
            sentence = f"{field.label} {in_unit(sentence[found.end() :], field.unit, field.factor)}"
    for path, field in sorted(fields.items(), key=lambda item: -len(item[0])):
        place, _, key = path.rpartition(".")
        sentence = sentence.replace(path, f"{field.label} ({place})")
        if "_" in key:  # others may be words of the sentence
            sentence = re.sub(rf"\b{key}\b", field.label, sentence)
    return sentence


def changes_in_words(before: Bench, after: Bench) -> str:
    """Name the settings of registration and reconstruction that differ, with their new values: "pupil modes 200"."""
    texts = [
        f"{name.replace('_', ' ')} {'automatic' if value is None else value}"
        for old, new in ((before.registration, after.registration), (before.reconstruction, after.reconstruction))
        for name, value in asdict(new).items()
        if value != getattr(old, name)
    ]
    return ", ".join(texts) or "the new lattice" * (before.lattice != after.lattice) or "the same settings"

"""`svwfs schema`: the JSON schema of a bench, with which an editor completes and checks one."""

import copy
import json
from typing import Any

import typer


def schema() -> None:
    """Print the JSON schema of a bench, with which an editor completes and checks a bench while you type.

    Write it into bench.schema.json next to your bench, and begin the bench with the line "#:schema bench.schema.json".

    Example: svwfs schema
    """
    typer.echo(json.dumps(editor_schema(), indent=1))


def editor_schema() -> dict[str, Any]:
    """Return the schema of a bench file as it is written by hand: values may be automatic, simulators unnamed."""
    from app.bench.config import AUTOMATIC, CHOSEN_IF_OMITTED, bench_schema

    draft = "http://json-schema.org/draft-07/schema#"
    made = {"$schema": draft, "title": "svwfs bench", **copy.deepcopy(bench_schema())}
    sections = made["properties"]
    for section, key in CHOSEN_IF_OMITTED:
        of = sections[section]["properties"]
        of[key] = {"description": of[key].pop("description"), "anyOf": [of[key], {"const": AUTOMATIC}]}
    lattice = sections["lattice"]
    place = {"required": lattice.pop("required")}
    lattice["anyOf"] = [place, {"required": ["arrangement"], "maxProperties": 1}]
    for section in ("camera", "light"):
        for each in sections[section]["oneOf"]:
            if each["properties"]["driver"]["const"] != "simulated":
                each["required"] = ["driver", *each.get("required", ())]
    return made

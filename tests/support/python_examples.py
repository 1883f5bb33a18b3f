"""Runs the examples in the docstrings of svwfs; those of the functions go on from that of the module."""

from __future__ import annotations

import doctest
from typing import Any

import svwfs


def run_examples() -> doctest.TestResults:
    background_estimator, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner()
    known: dict[str, Any] = {}
    for name in ("", *svwfs.__all__):
        given = getattr(svwfs, name) if name else svwfs
        for test in background_estimator.find(given, name or "svwfs", module=False, globs=known):
            runner.run(test, clear_globs=False)
            known = known or test.globs
    return runner.summarize()


if __name__ == "__main__":
    assert svwfs.__file__ is not None
    assert "site-packages" in svwfs.__file__, svwfs.__file__
    found = run_examples()
    raise SystemExit(found.failed or found.attempted < 30)

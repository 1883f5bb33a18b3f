"""Tests that fail under Wine alone, not on Windows, and why: `make windows TESTS=1` leaves them out."""

_STARTS_DASK = "Dask waits until ten looks at the time show only one or two; Wine's clock is too fine"
WINE_FAILURES = {
    "tests/app/batch/test_workers.py::test_errors_of_tasks_are_results": _STARTS_DASK,
    "tests/app/batch/test_workers.py::test_other_users_cannot_send_code_to_the_workers": _STARTS_DASK,
}

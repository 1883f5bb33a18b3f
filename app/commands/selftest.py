"""`svwfs selftest`: signs, axes and units against phases in closed form."""

from app.errors import RunError


def selftest() -> None:
    """Check signs, axes and units with phases known in closed form.

    Example: svwfs selftest
    """
    from rich.console import Console

    from app.evaluation.selftest import run_checks

    console, passed = Console(), []
    console.print("what was put in                       RMS (rad)   scale   residual (rad)")
    for check in run_checks():
        passed.append(check.passes)
        verdict = "[green]ok[/]" if check.passes else "[red]WRONG[/]"
        numbers = f"{check.rms_rad:9.3f}  {check.scale:6.3f}  {check.residual_rad:15.4f}"
        console.print(f"{check.name:36s}  {numbers}   {verdict}", highlight=False)
    if not all(passed):
        raise RunError("the selftest failed: this installation must not be trusted")

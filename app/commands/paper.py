"""`svwfs paper`: the tables of the paper beside its own numbers."""

from inspect import Signature, signature
from pathlib import Path
from typing import Annotated

import typer

from app.commands import options
from app.commands.study import run_and_print

paper = typer.Typer(
    help="Reproduce the paper's tables beside its own numbers.", no_args_is_help=True, rich_markup_mode=None
)
Out = Annotated[Path, options.folder_option("Folder for the table (JSON, CSV) and its figure.")]
Peers = Annotated[bool, typer.Option(help="Include the slow methods of SimpleITK (extra: peers).")]


def _add(name: str, preset: str, about: str, more: str = "", *, has_peers: bool = True) -> None:
    """Add the command of a table, a function of `app.evaluation.paper`; `more` options are in its example."""

    def reproduce(
        *,
        out: Out,
        seeds: options.Seeds = 1,
        peers: Peers = False,
        overwrite: options.Overwrite = False,
        bench: options.Bench = preset,
        setting: options.Set = None,
    ) -> None:
        from app.evaluation import paper as tables
        from app.evaluation.studies import files_of

        loaded, chosen = options.load(bench, setting), {"with_peers": peers} if has_peers else {}
        table = getattr(tables, name)(**chosen)
        options.check_files(*files_of([table], out), reads=loaded.files, overwrite=overwrite)
        run_and_print([table], loaded, seeds, out)

    own = [each for each in signature(reproduce).parameters.values() if has_peers or each.name != "peers"]
    reproduce.__signature__ = Signature(own)  # type: ignore[attr-defined] # for typer
    text = f"{about}\n\nExample: svwfs paper {name}{more} --out paper"
    paper.command(name, cls=options.OnceCommand, help=text)(reproduce)


_SIMULATION, _EXPERIMENT = "paper_simulation", "paper_experiment"
_add("table1", _SIMULATION, "Table 1: every method on the simulated bench, against the truth.")
_add("table2", _EXPERIMENT, "Table 2: every method on noisy frames of the experiment, against the stars.", " --seeds 3")
_add("sources", _SIMULATION, "The supplement's study of other source shapes.", has_peers=False)

"""Commands on VUTs that a user brings: vuts, check-vut, and the export of policies."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands import complete
from merge_sumo.commands.grouped import Commands
from merge_sumo.commands.shared import (
    DeadlineOption,
    InProcessOption,
    JsonOption,
    PoliciesOption,
    VutCommandOption,
    VutMemoryOption,
    app,
    print_result,
    settings_in,
    show,
)
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB, US23

policies = Commands(help="The learned drivers as files for others.", no_args_is_help=True)
app.add_typer(policies, name="policies")


@app.command()
def vuts(policies: PoliciesOption = None, as_json: JsonOption = False) -> None:
    """List the vehicles that can be tested: by name, and the kinds that you can bring.

    Example:  merge-sumo vuts
    """
    from merge_sumo.drivers.policies import policies_in, policies_of, read_manifest
    from merge_sumo.vuts.python import installed_vuts
    from merge_sumo.vuts.registry import KINDS, LEARNED, PYTHON, built_in_vuts

    trained = read_manifest(policies_of() if policies is None else policies_in(policies))
    built_in = [name for name in built_in_vuts() if LEARNED.get(name, name) in (name, *trained)]
    names = {"built in": built_in, "installed": list(installed_vuts())}
    kinds = [kind for kind in (PYTHON, *KINDS.values()) if kind.form]
    if as_json:
        listed = [{"form": kind.form, "what": kind.what, "example": kind.example} for kind in kinds]
        typer.echo(json.dumps({**names, "kinds": listed}))
        return
    for title, found in names.items():
        if found:
            show(f"{title}: {', '.join(found)}")
    for kind in kinds:
        for line in (kind.form, f"    {kind.what}", f"    {kind.example}"):
            show(line)


@app.command("check-vut")
def check_vut(
    context: typer.Context,
    vut: Annotated[
        str,
        typer.Argument(help="What you would write after --vut.", autocompletion=complete.vuts),
    ],
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    in_process: InProcessOption = False,
    policies: PoliciesOption = None,
    as_json: JsonOption = False,
) -> None:
    """Let a VUT drive a few cases and say what is wrong with it, and what a step of it costs.

    Says "nothing wrong" (exit code 0), or what is wrong in sentences (exit code 1).

    Example:  merge-sumo check-vut design1
    """
    from merge_sumo import api

    found = api.check_vut(**settings_in(context))
    print_result(found, as_json=as_json)
    raise typer.Exit(0 if found.ok else 1)


@policies.command("export")
def export_policy(
    name: Annotated[
        str, typer.Argument(help="pov1, vut1, pov2 or vut2.", autocompletion=complete.networks)
    ],
    out: Annotated[Path, typer.Option(help="ONNX file to write.")],
    policies: PoliciesOption = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Scenario that it is to drive in.",
            show_default="the one it was trained for",
            autocompletion=complete.scenarios,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write a learned driver as an ONNX network, from the state to the action values.

    Example:  merge-sumo policies export vut1 --out vut1.onnx
    """
    from merge_sumo.drivers.policies import policies_in, policies_of
    from merge_sumo.road.scenario_file import named_scenario
    from merge_sumo.vuts.onnx_export import export_onnx

    played = None if scenario is None else named_scenario(scenario)
    folder = policies_of(played or US23) if policies is None else policies_in(policies)
    export_onnx(name, out, folder, played)
    show(json.dumps({"written": [str(out)]}) if as_json else out)

"""Commands on VUTs that a user brings: vuts, check-vut, and the export of policies."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands.once import Application
from merge_sumo.commands.shared import (
    DeadlineOption,
    InProcessOption,
    JsonOption,
    PoliciesOption,
    VutCommandOption,
    VutMemoryOption,
    app,
    show,
)
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB, US23

policies = Application(help="The learned drivers as files for others.", no_args_is_help=True)
app.add_typer(policies, name="policies")


@app.command()
def vuts(policies: PoliciesOption = None, as_json: JsonOption = False) -> None:
    """List the vehicles that can be tested: by name, and the kinds that you can bring.

    Example:  merge-sumo vuts
    """
    from merge_sumo.drivers.policies import policies_in, policies_of, read_manifest
    from merge_sumo.drivers.vut import KINDS, LEARNED, PYTHON, built_in_vuts
    from merge_sumo.drivers.vuts.python import installed_vuts

    trained = read_manifest(policies_of() if policies is None else policies_in(policies))
    built_in = [name for name in built_in_vuts() if LEARNED.get(name, name) in (name, *trained)]
    names = {"built in": built_in, "installed": list(installed_vuts())}
    kinds = [PYTHON, *KINDS.values()]
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
    vut: Annotated[str, typer.Argument(help="What you would write after --vut.")],
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
    from merge_sumo.campaigns import vut_check
    from merge_sumo.drivers.policies import policies_in
    from merge_sumo.drivers.vut import vut_factory
    from merge_sumo.drivers.vuts.base import VutOptions

    options = VutOptions(
        command=vut_command,
        deadline_s=deadline,
        memory_gib=vut_memory,
        in_process=in_process,
        policies=None if policies is None else policies_in(policies),
    )
    found = vut_check.check_vut(vut_factory(vut, options))
    if as_json:
        typer.echo(json.dumps({"vut": vut, "ok": not found.problems, **asdict(found)}))
    else:
        for sentence in found.problems or ["nothing wrong"]:
            show(sentence)
        for sentence in found.notes:
            show(f"note: {sentence}")
        show(
            f"a step costs {found.us_per_step_median:.0f} us (median), "
            f"{found.us_per_step_worst:.0f} us at worst"
        )
    raise typer.Exit(1 if found.problems else 0)


@policies.command("export")
def export_policy(
    name: Annotated[str, typer.Argument(help="pov1, vut1, pov2 or vut2.")],
    out: Annotated[Path, typer.Option(help="ONNX file to write.")],
    policies: PoliciesOption = None,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Scenario that it is to drive in.  [default: the one it was trained for]",
        ),
    ] = None,
) -> None:
    """Write a learned driver as an ONNX network, from the state to the action values.

    Example:  merge-sumo policies export vut1 --out vut1.onnx
    """
    from merge_sumo.drivers.onnx_export import export_onnx
    from merge_sumo.drivers.policies import policies_in, policies_of
    from merge_sumo.scenarios.scenario_file import named_scenario

    played = None if scenario is None else named_scenario(scenario)
    folder = policies_of(played or US23) if policies is None else policies_in(policies)
    export_onnx(name, out, folder, played)
    show(out)

"""Commands and options of earlier versions, each with a sentence that names its successor."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import Final

from merge_sumo.errors import UserError

COMMANDS: Final[Mapping[str, str]] = {
    "board": "`merge-sumo report` prints on A4, and `report --json` has each fact with its source",
    "crosscheck": "`python tools/crosscheck.py RUN`, in a checkout, repeats cases in HighwayEnv",
    "policies": "`python tools/export_policy.py NAME FILE`, in a checkout, writes an ONNX network",
    "failures-per-merge": "`merge-sumo probability RUN --traffic NAME` says it",
    "compare-runs": "`merge-sumo compare RUN RUN...` compares what is recorded, and `merge-sumo "
    "rerun RUN --vut SPEC` runs the cases of one campaign with another VUT",
    "history": "`merge-sumo compare RUN RUN...` compares any number of recorded versions",
    "stress": "`merge-sumo rerun RUN --stress` does it",
    "certify": "after a campaign without failures, `merge-sumo probability RUN --cases 100000` "
    "bounds how much of the pool can fail",
}
"""What replaces a command, by its name."""
OPTIONS: Final[Mapping[str, str]] = {
    "--rerun": "`merge-sumo rerun RUN --vut SPEC` runs the cases of a campaign with another VUT",
    "--no-rerun": "`merge-sumo compare` always compares the records alone",
    "--tolerance": "`merge-sumo rerun` and `merge-sumo compare` end with 1 where any case broke, "
    "and --json has the number",
    "--audit": "`merge-sumo probability RUN` bounds, with fresh cases, how much fails where the "
    "campaign expects no failure",
    "--certificate": "`merge-sumo probability RUN --cases 100000` says more than a certificate",
    "--crime": "measures are not compared with those of CommonRoad-CriMe any more: "
    "docs/reference/measures.md has their definitions",
    "--in-process": "`merge-sumo run --debug` runs one case within reach of a debugger",
    "--net": "a scenario file names its net: `merge-sumo scenario new` writes one",
    "--people": "write a limit of what the POV may do as a criterion, as in --fail-when "
    "'clearance_m <= 0 and pov_sustained_brake_mps2 <= 2.06'",
    "--dask": "--workers takes the address of a Dask scheduler, too: --workers tcp://HOST:PORT",
    "--dense": "`merge-sumo truth --cases 1000000` makes a dense truth, which is used from then on",
    "--no-dense": "a dense truth is used where `merge-sumo truth --cases 1000000` has made one",
    "--learn-from": "a campaign learns by itself; --against OLD searches for what changed",
    "--limit": "`python tools/benchmark`, in a checkout, runs the frozen problems",
    "--problems": "`python tools/benchmark`, in a checkout, runs the frozen problems",
    "--samplers": "`merge-sumo benchmark` compares samplers on a VUT",
    "--stop-after-converged": "--stop-when-converged looks at what the last cases have added",
    "--truth-cases": "`merge-sumo benchmark` compares samplers on a VUT",
    "--trust-vut": "a run folder names no code to run: name a controller of your own again, --vut "
    "SPEC (and --pov)",
    "--force": "a campaign with something changed begins anew, in a folder of its own",
    "--vut-command": 'the spec has the command, as in --vut "traci:python my.py {port}"',
    "--v-vut0": "a scenario file has v_vut0_mps, and `merge-sumo run` has --at v_vut0_mps=NUMBER",
    "export commonroad": "`--format openscenario` writes the motion for other simulators",
    "export parquet": "`--format csv` writes the same table",
    "benchmark --quick": "`python tools/benchmark`, in a checkout, runs the frozen problems",
    "truth --repeat": "`merge-sumo campaign --sampler uniform --repeat N` repeats uniform cases",
    "truth --tolerate": "`merge-sumo campaign --sampler uniform --repeat N` takes --tolerate",
    "campaign --batch": "a sampler chooses the size of its batches; `ms.campaign(batch=20)` in "
    "Python has another",
    "repair --resume": "a repair begins anew in a folder of its own: the same seed gives the same "
    "values, and `trials.jsonl` of the other folder has its trials",
    "compare --vut": "`merge-sumo benchmark` compares samplers on a VUT",
}
"""What replaces an option, by its name with dashes, in every command that does not have it.

A command before the name limits the sentence to this command.
"""


def check_command(arguments: Sequence[str]) -> None:
    """Raise `UserError` where the first argument is a command that is gone."""
    if arguments and arguments[0] in COMMANDS:
        raise UserError(f"the command {arguments[0]} is gone: {COMMANDS[arguments[0]]}")


def check_options(command: str, arguments: Sequence[str], known: Container[str]) -> None:
    """Raise `UserError` where an argument is an option that is gone, and not a `known` one."""
    if command == "benchmark" and arguments and not arguments[0].startswith("-"):
        raise UserError(f"benchmark takes no samplers: {OPTIONS['benchmark --quick']}")
    for argument in arguments:
        name = argument.partition("=")[0]
        if name == "--":
            return
        successor = OPTIONS.get(f"{command} {name}") or OPTIONS.get(name)
        if successor is not None and name not in known:
            raise UserError(f"the option {name} is gone: {successor}")

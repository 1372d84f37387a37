"""Write the page of TraCI questions and commands: `python tools/traci_page.py`.

It is made from SUMO's own client and from the tables by which merge-sumo answers.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from merge_sumo.controllers.traci.session import QUESTIONS, Effect, effect_of, is_answered
from merge_sumo.sumo.traci_names import functions

HEADINGS = ("Answered", "Not answered", *(effect.value for effect in Effect))
PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "traci.md"
HEAD = """# TraCI

This page lists what a controller that drives by TraCI can ask and command, and what each command \
does. [The tutorial](../tutorials/traci-controller.md) shows how to write one.

`python tools/traci_page.py` makes this page from SUMO's own client: do not edit it.

## How SUMO answers

A second SUMO answers questions and carries out commands. It runs as a library in a separate \
process, without a port. It has the original net and all vehicles in their present state:

| vehicle | meaning |
|---|---|
| `vut` | VUT (vehicle under test): the vehicle that your controller drives |
| `pov` | POV (primary other vehicle): the vehicle on the mainline (main road) |
| `ahead`, `behind` | the cars ahead of and behind the POV, in traffic |

Questions:

- merge-sumo itself answers two questions that this SUMO cannot answer: the position of a vehicle \
after the step, and the vehicles that departed and arrived during several steps.
- A question about an unknown object is refused, as in SUMO.
- Subscriptions work for all variables of an object. Context subscriptions work for the vehicles \
around a vehicle or a junction, without filters. A subscription ends only when you end it: its \
begin and end time have no effect.
- `getCollisions` returns contacts. A contact does not change the motion.
- `getParameter("vut", "seed")` is the seed of the case.

Commands:

- Commands act on `vut` and its type. SUMO's step turns them into a speed. The campaign gives the \
VUT this speed by eq. (4) of the paper, within the limits of the scenario.
- `vut` departs with its speed set. A controller without commands keeps its speed.
- On a road with an acceleration lane, the lane that SUMO's step gives the VUT is its \
[merge request](vuts.md#merging-from-an-acceleration-lane).
- All other commands are accepted without effect, or refused with a reason as an error of that \
command. The connection stays open.

[Why SUMO decides](../explanation/decisions/traci-server.md) has the reasons.

## Differences from SUMO

In plain SUMO, `setSpeed` often seems to have no effect. In its default speed mode (31), other \
rules override it: the safe speed of the car-following model, right of way, red lights, and the \
limits of the vehicle. Here `vut` departs in speed mode 38: only the limits of the vehicle \
override `setSpeed`.

The rest is as in SUMO. A speed acts in the next step, and `getSpeed` returns the speed of the \
last step.

## Start, end and connection

- `--vut "traci:COMMAND {port}"` starts the program, starts it again if it ends, and stops it \
at the end. The port replaces `{port}`, and is in the environment variable \
`MERGE_SUMO_PORT`. If a program calls `traci.start(...)`, add this port as the argument `port=`.
- `--vut traci` waits for a program that you start, on 127.0.0.1:8813. `--vut traci:9000` waits on \
another port.
- The program can run for one episode, for several or for all. It can keep one connection or open \
a new one for each episode. merge-sumo serves one client at a time.
- In every episode the vehicles `pov` and `vut` depart. They arrive when the episode ends, or at \
the end of the net. The road is then empty for one step.
- SUMO opens no port. The only port of a campaign is on the loopback interface. On Linux it \
serves only connections of your user ([the rules, also for other systems]\
(../../SECURITY.md#the-traci-port)). The program can run elsewhere, for example in a \
container that shares the network, as the same user.
- If the program ends and a process that it started keeps the connection open, every case ends as \
an error.

## Commands that move the VUT

- `setSpeed` acts in the next step, until `setSpeed(-1)`.
- `setSpeed`, `slowDown` and `setAcceleration` set the speed. When `slowDown` or `setAcceleration` \
has ended, and after `setSpeed(-1)`, the car-following model of SUMO drives the VUT.
- `setSpeedMode(31)`, `setTau`, `openGap`, `setStop` and other commands act as in SUMO.
- `sigma` is 0, so that episodes do not depend on each other. `setImperfection` changes `sigma`, \
and episodes then depend on each other.
- Without an acceleration lane, lane changes have no effect. `changeSublane`, reroutes, colours \
and shapes, views, and keys of `setParameter` with a dot have no effect on any road. The scenario \
sets the path. If such a command could move a vehicle in SUMO, the last lines of a campaign name \
it, with the number of cases in which the controller gave it.
- `setParameter` stores keys without a dot.
- `moveTo`, `remove`, `saveState` and similar commands are refused. The connection stays open.

## A vehicle model of the controller

- `setPreviousSpeed` sets the speed of `vut` after the next step. It overrides all other commands, \
in any order, for this step only. In a step without it, a commanded speed acts, or `vut` keeps \
its speed. In a long `simulationStep(time)` it applies to all steps.
- `moveToXY` sets the position of the front bumper after the next step. merge-sumo derives the \
speed: the distance along the lane from the point of the previous step, divided by 0.1 s. The \
first point counts from the position of `vut`. `getPosition` then returns the point, as in SUMO.
- With `moveToXY`, `vut` has the new speed only from the end of the step on (eq. (4)). It is \
therefore a little before or after the point: by 0.1 s times the speed gained since the first \
point, and after a clipped step by the clipped distance. `getLanePosition`, gaps and verdicts use \
the position of `vut`.
- With `setPreviousSpeed` and `moveToXY` in the same step, the point changes only the answer of \
`getPosition`.
- `moveToXY` accepts points up to 2 m from the lane, and refuses others. Edge, lane, angle, \
`keepRoute` and `matchThreshold` have no effect. Next to an acceleration lane the nearer lane \
counts: a model that crosses over merges.
- The limits of the scenario clip the speed. `clipped_steps` counts clipped steps up to M, and \
`getSpeed` returns the driven speed. A model must continue from that speed. A negative speed is \
refused. A speed that is not a number ends the case as an error.
- In such a loop, plain SUMO returns from `getSpeed` the speed that its driver chose. Here \
`getSpeedWithoutTraCI` returns that speed, of the last step (after `setSpeed("vut", -1)`).
- Leave out `--act`, which adds its own delay and lag. A controller with its own \
first-order lag of 0.3 s drives like the same controller with `--act lag_s=0.3` in place of the \
lag, to 1e-6 m (`pytest tests/controllers/test_traci_commands.py -k VehicleModel`).

## Lane changes

- Edges and lanes come from the net file. In `us23-lane`, both lanes are on the edge `lane`, \
and lane 0 is the acceleration lane. `getLanePosition`, `getNeighbors`, `getLeftFollowers`, \
`couldChangeLane` and similar functions use these lanes.
- `vut` departs in lane change mode 0: only the controller changes its lane. `changeLane` and \
`changeLaneRelative` act in the next step, whatever drives on the other lane. A controller that \
never changes lanes drives to the end of the lane. There the VUT is moved or stopped, as the \
scenario sets it.
- `setLaneChangeMode` acts as in SUMO. In mode 512 SUMO refuses a change into a gap that it \
considers unsafe. In mode 1621, the default of SUMO, the lane-change model merges by itself. It \
adapts the speed only after `setSpeed("vut", -1)`. The car-following model then stops before the \
end of the lane until the VUT can merge.
- The merge is final: a later lane change of `vut` is undone.

## All functions

The following lists have all functions of SUMO's client, by domain.
"""
TAIL = """
## Next step

- [A TraCI controller](../tutorials/traci-controller.md) writes and runs one.
- [Kinds of controllers](vuts.md) has the rules that all controllers follow.
"""


def sections() -> Iterator[str]:
    """Yield the page, domain by domain."""
    yield HEAD
    domains: dict[str, dict[str, list[str]]] = {}
    for (command, _), names in functions().items():
        domain = names[0].partition(".")[0]
        if command in QUESTIONS:
            heading = "Answered" if is_answered(names) else "Not answered"
        else:
            heading = effect_of(names).value
        listed = domains.setdefault(domain, {}).setdefault(heading, [])
        listed += [f"`{name.partition('.')[2]}`" for name in names]
    for domain, mine in sorted(domains.items(), key=lambda item: (item[0] != "vehicle", item[0])):
        yield f"\n### {domain}\n"
        for heading in HEADINGS:
            if heading in mine:
                yield f"\n{heading}: {', '.join(sorted(mine[heading]))}.\n"
    yield TAIL


def page() -> str:
    """Return the page."""
    return "".join(sections())


def main() -> None:
    """Write it."""
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)


if __name__ == "__main__":
    main()

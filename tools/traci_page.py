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

This page lists the TraCI questions and commands that a controller can use, and what each command \
does. [The tutorial](../tutorials/traci-controller.md) shows how to write one.

`python tools/traci_page.py` makes this page from SUMO's own client: do not edit it.

## How SUMO answers

Your controller talks to a second SUMO, which answers its questions and carries out its commands. \
This SUMO runs as a library in a separate process, without a port. It contains the original net \
and all vehicles in their present state:

| vehicle | meaning |
|---|---|
| `vut` | VUT (vehicle under test): the vehicle that your controller drives |
| `pov` | POV (primary other vehicle): the vehicle on the mainline (main road) |
| `ahead`, `behind` | the cars ahead of and behind the POV, in traffic |

Questions:

- This SUMO cannot answer two questions, so merge-sumo answers them: the position of a vehicle \
after the step, and the vehicles that departed and arrived during several steps.
- A question about an unknown object returns an error, as in SUMO.
- Subscriptions work for all variables of an object. Context subscriptions work for the vehicles \
around a vehicle or a junction, without filters. A subscription ends only when you end it: its \
begin and end time have no effect.
- `getCollisions` returns contacts. A contact does not change the motion.
- `getParameter("vut", "seed")` is the seed of the case.

Commands:

- Commands act on `vut` and its type. In its step, the second SUMO computes the speed that \
follows from them. merge-sumo then gives the VUT this speed by eq. (4), the paper's equation of \
motion, within the limits of the scenario.
- `vut` departs as if `setSpeed` had set its speed. Without commands it keeps this speed.
- On a road with an acceleration lane, the lane of `vut` after SUMO's step is the [merge \
request](vuts.md#merging-from-an-acceleration-lane).
- Other commands have no effect, or return an error with the reason. The connection stays open in \
both cases.

[Why SUMO decides](../explanation/decisions/traci-server.md) has the reasons.

## Differences from SUMO

In plain SUMO, `setSpeed` often seems to have no effect. In its default speed mode (31), other \
rules override it: the safe speed of the car-following model, right of way, red lights, and the \
limits of the vehicle. Here `vut` departs in speed mode 38: only the limits of the vehicle \
override `setSpeed`.

The rest is as in SUMO. A speed acts in the next step, and `getSpeed` returns the speed of the \
last step.

## Start, end and connection

- `--vut "traci:COMMAND {port}"` starts your program, and starts it again if it ends. It stops \
the program at the end of the campaign. merge-sumo replaces `{port}` by the port, and also sets \
the environment variable `MERGE_SUMO_PORT` to it. If a program calls `traci.start(...)`, add this \
port as the argument `port=`.
- `--vut traci` waits for a program that you start, on 127.0.0.1:8813. `--vut traci:9000` waits \
on another port.
- The program can run for one episode, for several or for all. It can keep one connection or open \
a new one for each episode. merge-sumo serves one client at a time.
- An episode is one simulated case. At its start the vehicles `pov` and `vut` depart. A vehicle \
arrives when the episode ends, or when it reaches the end of the net. Between two episodes the \
road is empty for one step.
- SUMO opens no port. merge-sumo opens one port, on the loopback interface. On Linux this port \
serves only connections of your user ([the rules, also for other \
systems](../../SECURITY.md#the-traci-port)). The program can also run in a container, if the \
container shares the network and the program runs as the same user.
- The program can start another process, which keeps the connection open after the program has \
ended. Then every case ends as an error.

## Commands that move the VUT

- `setSpeed` acts in the next step, until `setSpeed(-1)`.
- `slowDown` and `setAcceleration` set the speed for a time. After this time, and after \
`setSpeed(-1)`, the car-following model of SUMO drives the VUT.
- `setSpeedMode(31)`, `setTau`, `openGap`, `setStop` and other commands act as in SUMO.
- `sigma` is 0, so that episodes do not depend on each other. `setImperfection` changes `sigma`, \
and episodes then depend on each other.
- The scenario sets the path of the VUT. Lane changes therefore have no effect on a road without \
an acceleration lane. On all roads, these commands have no effect: `changeSublane`, reroutes, \
colours and shapes, views, and keys of `setParameter` with a dot.
- Some commands without effect could move a vehicle in SUMO. The last lines of a campaign name \
these commands, and in how many cases the controller used them.
- `setParameter` stores keys without a dot.
- `moveTo`, `remove`, `saveState` and similar commands return an error. The connection stays open.

## A vehicle model of the controller

A controller can contain its own vehicle model, and tell merge-sumo the speed or the position \
that this model reaches:

- `setPreviousSpeed` sets the speed that `vut` has after the next step. In this step it overrides \
all other commands, whether they come before or after it. In a step without it, `vut` follows the \
last command that set a speed, or keeps its speed. A call of `simulationStep(time)` can contain \
several steps: `setPreviousSpeed` then applies to all of them.
- `moveToXY` sets the position of the front bumper after the next step. merge-sumo computes the \
speed from it: the distance along the lane since the point of the previous step, divided by 0.1 \
s. For the first point, it takes the distance from the position of `vut`. `getPosition` then \
returns the point, as in SUMO.
- With `moveToXY`, the position of `vut` differs slightly from the point, because `vut` reaches \
the new speed only at the end of the step (eq. (4)). The difference is 0.1 s times the speed \
gained since the first point. A clipped step changes it by the clipped distance. \
`getLanePosition`, gaps and verdicts use the position of `vut`, not the point.
- If a step has both `setPreviousSpeed` and `moveToXY`, the speed comes from `setPreviousSpeed`. \
The point then changes only the answer of `getPosition`.
- `moveToXY` accepts points up to 2 m from the lane, and refuses others. Edge, lane, angle, \
`keepRoute` and `matchThreshold` have no effect. On a road with an acceleration lane, `vut` is on \
the lane that is nearer to the point: a model that crosses to the mainline merges.
- The limits of the scenario clip the speed. `clipped_steps` counts the clipped steps before the \
merge point M. `getSpeed` returns the clipped speed, and your model must continue from it. A \
negative speed returns an error. A speed that is not a number ends the case as an error.
- In plain SUMO, a model that calls `setPreviousSpeed` in each step gets from `getSpeed` the \
speed that SUMO's driver chose. Here `getSpeedWithoutTraCI` returns the speed that SUMO's driver \
chose in the last step, if you called `setSpeed("vut", -1)` before.
- Leave out `--act`, which adds its own delay and lag. The results agree: a controller with its \
own first-order lag of 0.3 s moves as the same controller without this lag and with `--act \
lag_s=0.3`, to 1e-6 m (`pytest tests/controllers/test_traci_commands.py -k VehicleModel`).

## Lane changes

- Edges and lanes come from the net file. In `us23-lane`, both lanes are on the edge `lane`, and \
lane 0 is the acceleration lane. `getLanePosition`, `getNeighbors`, `getLeftFollowers`, \
`couldChangeLane` and similar functions use these lanes.
- `vut` departs in lane change mode 0: only the controller changes its lane. `changeLane` and \
`changeLaneRelative` act in the next step, even if another vehicle is in the way. If the \
controller never changes the lane, the VUT drives to the end of the acceleration lane. There \
merge-sumo moves it to the mainline, or stops it if the scenario sets `lane_end = "stop"`.
- `setLaneChangeMode` acts as in SUMO. In mode 512 SUMO refuses a change into a gap that it \
considers unsafe. In mode 1621, the default of SUMO, the lane-change model merges by itself. It \
can adapt the speed only after `setSpeed("vut", -1)`. The car-following model then stops the VUT \
before the end of the lane, until the VUT can merge.
- The merge is final: merge-sumo undoes a later lane change of `vut`.

## All functions

These lists contain all functions of SUMO's client, by domain. "Refused" means that the command \
returns an error.
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

"""Write the page of what a TraCI client may ask and command: `python tools/traci_page.py`.

It is made from SUMO's own client and from the tables by which merge-sumo answers.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from merge_sumo.controllers.traci.session import QUESTIONS, Effect, effect_of, is_answered
from merge_sumo.sumo.traci_names import functions

HEADINGS = ("Answered", "Not answered", *(effect.value for effect in Effect))
PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "traci.md"
HEAD = """# What a TraCI controller can do

In plain SUMO `setSpeed` often seems to do nothing, because in its default speed mode (31) the \
safe speed of the car-following model, right of way, red lights, and the vehicle's own limits of \
acceleration and speed override it. It acts in the next step, while `getSpeed` answers the speed \
of the last one, and it holds until `setSpeed(-1)`, from where on the car-following model drives. \
All of that is the same here but for the speed mode: `vut` departs in 38, in which its own limits \
act and the rest does not.

Made by `python tools/traci_page.py` from SUMO's own client: do not edit.

A second SUMO answers questions. It has the original net and the vehicles `pov` and `vut` (in \
traffic also `ahead` and `behind`) in their present state, and runs as a library in a process of \
its own, without a port. merge-sumo itself answers what this SUMO cannot know: the position of a \
vehicle after the step, and the vehicles that departed and arrived during several steps. A \
question about an unknown object is refused as by SUMO. Subscriptions to variables of an object \
are available for all questions, and context subscriptions for the vehicles around a vehicle or a \
junction, without filters; they hold until they are ended, \
whatever their begin and end. `getCollisions` tells of contacts, which change no motion.

The same SUMO carries out commands on `vut` and its type; the speed that its step gives the VUT is \
the command of the controller, and the campaign then moves the VUT by eq. (4), within the \
scenario's limits. `vut` departs with its speed set, so a controller without commands keeps its \
speed. Speed mode 31, `setSpeed(-1)`, `setTau`, `openGap` and `setStop` have their \
meaning in SUMO, whose car-following model then drives the VUT (deterministically: `sigma` is 0, \
unless `setImperfection` changes it). On a road with an acceleration lane the lane that the step \
gives the VUT is its merge request; `vut` departs in lane change mode 0, so nothing but the \
controller changes its lane ([Lane changes](../tutorials/traci-controller.md#lane-changes)).

`setPreviousSpeed` and `moveToXY` say what [a vehicle model of the controller's own]\
(../tutorials/traci-controller.md#a-vehicle-model-of-your-own) has reached after the step; they go \
before SUMO's speed. `getParameter("vut", "seed")` is the seed of the case. Other commands are \
accepted without effect (the last lines of a campaign name those that could move a vehicle in \
SUMO), or refused with a reason, as an error of that command; \
the connection stays open. [Why SUMO decides](../explanation/decisions/traci-server.md).
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
        yield f"\n## {domain}\n"
        for heading in HEADINGS:
            if heading in mine:
                yield f"\n{heading}: {', '.join(sorted(mine[heading]))}.\n"


def page() -> str:
    """Return the page."""
    return "".join(sections())


def main() -> None:
    """Write it."""
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)


if __name__ == "__main__":
    main()

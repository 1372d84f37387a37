"""Write the page of what a TraCI client may ask and command: `python tools/traci_page.py`.

It is made from SUMO's own client and from the tables by which merge-sumo answers.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from merge_sumo.sumo.traci_names import Named, named
from merge_sumo.vuts.traci.commands import Effect, effect_of, reason_against
from merge_sumo.vuts.traci.questions import NOT_ANSWERED
from merge_sumo.vuts.traci.session import OWN_ANSWERS, QUESTIONS

PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "traci.md"
HEAD = """# What a TraCI controller can do

Made by `python tools/traci_page.py` from SUMO's own client: do not edit.

A shadow SUMO answers questions. It has the original net and the vehicles `pov` and `vut` (in \
traffic also `ahead` and `behind`) in their present state, and runs as a library in a process of \
its own, without a port. merge-sumo itself answers what this SUMO cannot know: the position of a \
vehicle after the step, and the vehicles that departed and arrived during several steps. A \
question about an unknown object is refused as by SUMO. Subscriptions and context subscriptions \
are available for all questions, without filters of contexts.

The same SUMO carries out commands on `vut` and its type; the speed that its step gives the VUT is \
the command of the controller, and the campaign then moves the VUT by eq. (4), within the \
scenario's limits. `vut` departs in speed mode 38 with its speed set, so a controller without \
commands keeps its speed: limits of acceleration act, SUMO's checks of safe speed, right of way \
and red lights do not. Speed mode 31, `setSpeed(-1)`, `setTau`, `openGap` and `setStop` have their \
meaning in SUMO, whose car-following model then drives the VUT (deterministically: `sigma` is 0, \
unless `setImperfection` changes it). On a road with an acceleration lane the lane that the step \
gives the VUT is its wish to merge; `vut` departs in lane change mode 0, so nothing but the \
controller changes its lane ([Lane changes](../tutorials/traci-controller.md#lane-changes)). Other \
commands are accepted without effect (with one note in \
`controller.log`), or refused with a reason, as an error of that command; the connection stays \
open. [Why SUMO decides](../decisions/traci-server.md).
"""


def sections() -> Iterator[str]:
    """Yield the page, domain by domain."""
    yield HEAD
    domains: dict[str, list[Named]] = {}
    for found in named().values():
        domains.setdefault(found.functions[0].partition(".")[0], []).append(found)
    for domain, mine in sorted(domains.items(), key=lambda item: (item[0] != "vehicle", item[0])):
        asks = [f for f in mine if f.command in QUESTIONS]
        sets = [f for f in mine if f.command not in QUESTIONS]
        own = [f for f in asks if (f.command, f.variable) in OWN_ANSWERS]
        unanswered = [
            f for f in asks if domain == "gui" or not NOT_ANSWERED.isdisjoint(f.functions)
        ]
        yield f"\n## {domain}\n"
        refused: dict[str, list[Named]] = {}
        for found in sets:
            if effect_of(found.functions) is Effect.REFUSED:
                refused.setdefault(reason_against(found.functions), []).append(found)
        for what, those in (
            ("Answered here", own),
            ("Answered by SUMO", [f for f in asks if f not in own and f not in unanswered]),
            ("Not answered", unanswered),
            *(
                (effect.value, [f for f in sets if effect_of(f.functions) is effect])
                for effect in (Effect.CARRIED_OUT, Effect.ON_A_LANE, Effect.NOTHING)
            ),
            *((f"Refused ({reason})", those) for reason, those in refused.items()),
        ):
            names = sorted(n.partition(".")[2] for f in those for n in f.functions)
            if names:
                yield f"\n{what}: {', '.join(f'`{name}`' for name in names)}.\n"


def page() -> str:
    """Return the page."""
    return "".join(sections())


def main() -> None:
    """Write it."""
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)


if __name__ == "__main__":
    main()

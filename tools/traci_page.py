"""Write the page of what a TraCI client may ask and command: `python tools/traci_page.py`.

It is made from SUMO's own client and from the tables by which merge-sumo answers.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from merge_sumo.drivers.vuts.traci_commands import Kind, kind_of, reason_against
from merge_sumo.drivers.vuts.traci_session import ASKS
from merge_sumo.drivers.vuts.traci_variables import GETTERS
from merge_sumo.sumo.traci_names import Named, named

PAGE = Path(__file__).resolve().parent.parent / "docs" / "reference" / "traci.md"
HEAD = """# What a TraCI controller can do

Made by `python tools/traci_page.py` from SUMO's own client: do not edit.

Questions are answered as SUMO answers them, about the net as it is in its file and the vehicles \
`pov` and `vut` (in traffic also `ahead` and `behind`). What is needed in every step, merge-sumo \
answers itself. The rest is passed on to a SUMO beside it, which is started for the first such \
question and has the same vehicles in the same state; it holds up the first answer by a fraction \
of a second. A question about an object that there is not is refused as by SUMO. Subscriptions \
and context subscriptions take all of it, too, but no filters of contexts.

Commands drive the VUT, which moves as a car that is commanded in SUMO in speed mode 38: limits of \
acceleration and speed that a controller sets act, SUMO's checks of safe speed, right of way and \
red lights do not. Or they are kept for what SUMO answers, or accepted because they can change \
nothing here (all of which is noted once in `controller.log`), or they are refused by name and \
with a reason, as an error of that command: the connection stays.
"""


def sections() -> Iterator[str]:
    """Yield the page, domain by domain."""
    yield HEAD
    domains: dict[str, list[Named]] = {}
    for found in named().values():
        domains.setdefault(found.functions[0].partition(".")[0], []).append(found)
    for domain, mine in sorted(domains.items(), key=lambda item: (item[0] != "vehicle", item[0])):
        asks = [f for f in mine if f.command in ASKS]
        sets = [f for f in mine if f.command not in ASKS]
        own = [f for f in asks if f.variable in GETTERS.get(f.command, {})]
        yield f"\n## {domain}\n"
        refused: dict[str, list[Named]] = {}
        for found in sets:
            if kind_of(found.functions) is Kind.REFUSED:
                refused.setdefault(reason_against(found.functions), []).append(found)
        for what, those in (
            ("Answered here", own),
            ("Answered by SUMO", [f for f in asks if f not in own]),
            *(
                (kind.value, [f for f in sets if kind_of(f.functions) is kind])
                for kind in (Kind.DRIVES, Kind.KEPT, Kind.NOTHING)
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

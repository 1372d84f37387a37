"""The traffic on a mainline: how dense it is, and how fast its cars are, with a source.

density_veh_per_km = 8.7         # of the lane beside the ramp, before the ramp meets it
source = "who has measured it, and where it is published"

[speeds]                         # m/s
kind = "normal"
mean = 25.1
sd = 2.85
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

from msgspec import Meta

from merge_sumo.analysis.exposure import Distribution, Histogram, Normal, read_distribution
from merge_sumo.errors import UserError
from merge_sumo.records import Record, convert, read_toml
from merge_sumo.scenario.scenario import Scenario, as_merge
from merge_sumo.suggestions import meant

FOLDER: Final = Path(__file__).resolve().parent / "traffics"
SUFFIX: Final = ".toml"
LEAST_INSIDE: Final = 0.01
"""Share of the speeds of a traffic that a pool has at least, or nothing is estimated."""


class Traffic(Record, frozen=True):
    """A traffic as its file states it.

    Attributes:
        source: where the figures are from.
        speeds: of the cars of the lane beside the ramp, in m/s.
        density_veh_per_km: cars per kilometre of that lane, before the ramp meets it; 1,000 would
            be cars of a metre, one behind the other.
        name: name of its file.
    """

    source: Annotated[str, Meta(min_length=1, description="a text: where the figures are from")]
    speeds: Normal | Histogram
    density_veh_per_km: Annotated[float, Meta(gt=0.0, le=1000.0)]
    name: str = ""

    def share_in_pool(self, scenario: Scenario) -> float:
        """Return the share of the speeds within the pool of a scenario.

        Raises:
            UserError: where the scenario has no coordinates of a single car of the mainline, or
                the pool next to no speeds of this traffic.
        """
        merge = as_merge(scenario)
        if merge.vehicles > 2:
            raise UserError(
                f"{merge.name} has cars ahead of the POV and behind it, at headways of its own: a "
                "traffic needs a scenario without them"
            )
        low, high = merge.v_pov0_mps
        below, up_to = self.speeds.ends(low, high).tolist()
        if up_to - below < LEAST_INSIDE:
            raise UserError(
                f"less than {LEAST_INSIDE:.0%} of the speeds of {self.name} lie in the pool, "
                f"{low:g} to {high:g} m/s: run the campaign on a scenario with other v_pov0_mps"
            )
        return float(up_to - below)

    def in_pool(self, scenario: Scenario, levels: Sequence[int]) -> Distribution:
        """Return how often the cases of a scenario occur, levels alike.

        Where cars start is uniform, and so is psi. Raises `UserError` as `share_in_pool`.
        """
        self.share_in_pool(scenario)
        uniform = read_distribution(None, levels, scenario)
        return replace(uniform, marginals={**uniform.marginals, "v_pov0_mps": self.speeds})

    def cars_in_pool(self, scenario: Scenario) -> float:
        """Return how many cars of the mainline, per merge, start in the pool of a scenario."""
        low_m, high_m = as_merge(scenario).x_pov0_m
        return self.density_veh_per_km / 1000.0 * (high_m - low_m) * self.share_in_pool(scenario)


def shipped_traffics() -> list[str]:
    """Return the names of the traffics that the package brings."""
    return sorted(path.stem for path in FOLDER.glob(f"*{SUFFIX}"))


def named_traffic(name: str) -> Traffic:
    """Return the traffic of a name or of a TOML file; `UserError` where there is none."""
    known = shipped_traffics()
    if name not in known and not name.endswith(SUFFIX):
        raise UserError(
            f"there is no traffic {name!r}: {meant(name, known)}choose {', '.join(known)}, or a "
            f"file NAME{SUFFIX}"
        )
    path = FOLDER / f"{name}{SUFFIX}" if name in known else Path(name)
    _, record = read_toml(path, "traffic")
    try:
        traffic = convert({"name": path.stem, **record}, Traffic)
        traffic.speeds.law(0.0, 1.0)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return traffic

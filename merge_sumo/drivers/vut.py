"""The VUT: from what a person writes after `--vut` to a driver."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from merge_sumo.drivers.base import Driver
from merge_sumo.drivers.level0 import Level0Vut
from merge_sumo.drivers.policies import load_driver, read_manifest
from merge_sumo.drivers.rule_based import DESIGNS, RuleBasedVut
from merge_sumo.errors import UserError

VutFactory = Callable[[int], Driver]
"""Makes a driver for a number of corridors."""


def built_in_vuts() -> dict[str, VutFactory]:
    """Return the VUTs that the package brings, by name."""
    designs = {name: partial(RuleBasedVut, design=design) for name, design in DESIGNS.items()}
    learned = {
        f"level{name[-1]}": partial(load_driver, name)
        for name in read_manifest()
        if name.startswith("vut")
    }
    return {"level0": Level0Vut, **learned, **designs}


def vut_factory(spec: str) -> VutFactory:
    """Return what makes the VUT that `spec` names; `UserError` for a name nobody knows."""
    vuts = built_in_vuts()
    if spec not in vuts:
        raise UserError(f"there is no VUT {spec!r}: choose one of {', '.join(vuts)}")
    return vuts[spec]

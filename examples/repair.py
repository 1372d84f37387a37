"""Search for parameter values with which the failing cases of a controller pass.

python examples/repair.py runs/repaired

Copy this script, and set the constants below to your controller, its parameters and your
scenario. `docs/how-to/repair.md` explains each step.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import optuna

import merge_sumo as ms

VUT = "design1"
CURRENT = {"gap_m": 13.7, "x2_m": 30.8}
RANGES = {"gap_m": (10.0, 30.0), "x2_m": (20.0, 90.0)}
SETTINGS: dict[str, Any] = {"level": 0, "cases": 80}
TRIALS = 20


def with_values(values: dict[str, float]) -> str:
    """Return the spec of the controller with these values."""
    return f"{VUT}?" + "&".join(f"{name}={value:.4g}" for name, value in values.items())


def changes(before: str | Path, vut: str) -> Counter[str]:
    """Run recorded cases with another controller, and count the cases of each change."""
    (step,) = ms.rerun(before, vut=vut, progress=False).to_record()["steps"]
    return Counter(case["change"] for case in step["cases"])


def main(folder: Path) -> None:
    """Search for values in the cases of one campaign, and confirm them in another campaign."""
    campaign = ms.campaign(VUT, seed=1, out=folder / "campaign", **SETTINGS)
    (cases,) = ms.export(campaign, file_format="cases", out=folder / "cases.toml")

    def objective(trial: optuna.Trial) -> float:
        values = {name: trial.suggest_float(name, *ends) for name, ends in RANGES.items()}
        became = changes(cases, with_values(values))
        change = 0.0
        for name, (low, high) in RANGES.items():
            change += abs(values[name] - CURRENT[name]) / (high - low)
        # Failing cases count first. Between values with equal failures the smallest change wins.
        return became["broke"] + became["pass with neither"] + change / len(RANGES)

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=1))
    study.enqueue_trial(CURRENT)
    study.optimize(objective, TRIALS)
    repaired = with_values(study.best_params)

    # Search for failures of the new values, and run the same cases with the current ones.
    fresh = ms.campaign(repaired, seed=2, out=folder / "fresh", **SETTINGS)
    became = changes(fresh.folder, VUT)  # from the new values to the current ones
    current, both = became["broke"], became["pass with neither"]
    new = became["fixed"] + became["contact without failure"]
    print(f"{repaired} in {len(fresh.cases)} fresh cases:")
    print(f"{current} fail with the current values only, {new} with the new values only,", end=" ")
    verdict = "confirmed" if current and not new else "not confirmed, these values are not a repair"
    print(f"{both} with both: {verdict}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

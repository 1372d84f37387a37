"""Search values of a controller's parameters with which the failures of a campaign pass.

python examples/repair.py runs/repaired

Write your controller, its parameters and your scenario into the constants below.
`docs/how-to/repair.md` explains it.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import optuna

import merge_sumo as ms

VUT = "design1"
TODAY = {"gap_m": 13.7, "x2_m": 30.8}
RANGES = {"gap_m": (10.0, 30.0), "x2_m": (20.0, 90.0)}
SETTINGS: dict[str, Any] = {"level": 0, "cases": 80}
TRIALS = 20


def with_values(values: dict[str, float]) -> str:
    """Return the controller with these parameters."""
    return f"{VUT}?" + "&".join(f"{name}={value:.4g}" for name, value in values.items())


def changes(before: str | Path, vut: str) -> Counter[str]:
    """Run recorded cases with another controller; count what became of them."""
    (step,) = ms.rerun(before, vut=vut, progress=False).to_record()["steps"]
    return Counter(case["change"] for case in step["cases"])


def main(folder: Path) -> None:
    """Search in the cases of one campaign, and confirm the values in those of another."""
    campaign = ms.campaign(VUT, seed=1, out=folder / "campaign", **SETTINGS)
    (cases,) = ms.export(campaign, file_format="cases", out=folder / "cases.toml")

    def objective(trial: optuna.Trial) -> float:
        values = {name: trial.suggest_float(name, *ends) for name, ends in RANGES.items()}
        became = changes(cases, with_values(values))
        change = 0.0
        for name, (low, high) in RANGES.items():
            change += abs(values[name] - TODAY[name]) / (high - low)
        # Whole cases come first; of values that fail alike, the smallest change is the best.
        return became["broke"] + became["pass with neither"] + change / len(RANGES)

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=1))
    study.enqueue_trial(TODAY)
    study.optimize(objective, TRIALS)
    repaired = with_values(study.best_params)

    # A search of its own against the new values: do they hold where today's fail?
    fresh = ms.campaign(repaired, seed=2, out=folder / "fresh", **SETTINGS)
    became = changes(fresh.folder, VUT)  # from the new values to today's
    today, both = became["broke"], became["pass with neither"]
    new = became["fixed"] + became["contact without failure"]
    print(f"{repaired}: of {len(fresh.cases)} fresh cases {today} fail with today's values alone,")
    print(f"{new} with the new values alone, {both} with both:", end=" ")
    print("confirmed" if today and not new else "not confirmed, these values are no repair")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

"""The page of the benchmark of samplers: the numbers, and a chart of each problem.

It is one HTML file without scripts that loads nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from contest import (
    FIRST_SEED,
    SamplerBenchmark,
    ratio_text,
    truth_share,
)
from jinja2 import Environment, Template
from markupsafe import Markup
from problems import Problem

from merge_sumo.reports.comparison_page import STYLES
from merge_sumo.reports.pages import source_of

PLAIN_COLOUR: Final = "#7B3294"
COLOUR: Final = re.compile(r"#[0-9A-Fa-f]{6}")
DASHES: Final = ("none", "7 3", "2 3", "7 2 2 2", "4 2")
"""Of the lines of samplers, one after the other: colours alone do not tell all of them apart."""
ORACLE: Final = "oracle"


@dataclass(frozen=True, slots=True)
class Curve:
    """A curve of a chart: name, colour, dashes, and its points as "x,y x,y"; no colour is ink."""

    name: str
    colour: str
    dashes: str
    points: str


@dataclass(frozen=True, slots=True)
class ProblemChart:
    """Curves of all samplers on a problem; `across` are (pixel, words)."""

    problem: Problem
    curves: list[Curve]
    across: list[tuple[float, str]]


def contest_page(result: SamplerBenchmark) -> str:
    """Return the page of a benchmark as HTML."""
    own = Path(__file__).with_suffix(".css").read_text(encoding="utf-8")
    return _template().render(
        style=Markup("".join([*map(source_of, STYLES), own])),  # noqa: S704 (our own files)
        result=result,
        scores=list(result.samplers.values()),
        first_seed=FIRST_SEED,
        ratio_text=ratio_text,
        charts=[_chart(result, problem) for problem in result.settings.problems],
        up=[(_up(share), f"{share:g}") for share in (0.0, 0.5, 0.9, 1.0)],
        faults=[
            (score.entrant.label, name, seed, fault)
            for score in result.samplers.values()
            for name, one in score.problems.items()
            for seed, fault in one.faults.items()
        ],
    )


def _template() -> Template:
    environment = Environment(autoescape=True, trim_blocks=True)
    return environment.from_string(
        Path(__file__).with_name("contest_page.html.jinja").read_text(encoding="utf-8")
    )


def _chart(result: SamplerBenchmark, problem: Problem) -> ProblemChart:
    settings, truth = result.settings, result.truths[problem.name]
    curves = []
    for place, score in enumerate(result.samplers.values()):
        colour = score.entrant.colour
        curves.append(
            Curve(
                score.entrant.label,
                colour if COLOUR.fullmatch(colour) else PLAIN_COLOUR,
                DASHES[place % len(DASHES)],
                _points(score.problems[problem.name].curve, settings.cases),
            )
        )
    best = {n: truth_share(truth, n) for n in settings.curve}
    curves.append(Curve(ORACLE, "", "1 3", _points(best, settings.cases)))
    ticks = sorted({0, settings.cases, *settings.counted})
    return ProblemChart(problem, curves, [(_across(n / settings.cases), str(n)) for n in ticks])


def _points(curve: Mapping[int, float], cases: int) -> str:
    """Return the points of a curve, from no case on."""
    places = [(0, 0.0), *curve.items()]
    return " ".join(f"{_across(n / cases)},{_up(share)}" for n, share in places)


def _across(share: float) -> float:
    """Return the pixel at a share of the way from left to right."""
    return round(34.0 + 318.0 * share, 1)


def _up(share: float) -> float:
    """Return the pixel at a share of the way from the bottom up."""
    return round(150.0 - 140.0 * share, 1)

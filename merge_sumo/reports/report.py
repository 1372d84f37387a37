"""The report of a campaign: one HTML file that needs no network.

What a reader needs is in the page as text and tables; maps, motion and charts are drawn by
`templates/report.js` from JSON in the page. Names and messages come from outside, so the template
escapes them, the JSON holds no "<", the script sets text and never markup, and the page's own
policy lets nothing run but that script and lets nothing load at all.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.campaigns.conductor import SCENARIOS, case_name
from merge_sumo.campaigns.experiments import TRUTH_CASES, Kept, Truth, read_truth
from merge_sumo.campaigns.ground import road_for
from merge_sumo.campaigns.run import SETTINGS, Run, failures
from merge_sumo.campaigns.settings import versions
from merge_sumo.drivers.vuts.output import LOG, end_of
from merge_sumo.errors import UserError
from merge_sumo.reports.diagnosis import (
    CEDED_MPS,
    MEANING,
    Diagnosis,
    Kind,
    diagnose,
    failure_boxes,
)
from merge_sumo.reports.summary import LevelSummary, Summary, summarise
from merge_sumo.reports.surface import FEWEST_FAILURES, PLAUSIBLE, Surface, learn_surface
from merge_sumo.reports.verdict import Trouble, Verdict, counted, in_words, judge, shortened
from merge_sumo.sumo.corridor import Corridor, LanePath
from merge_sumo.sumo.road import road_of
from merge_sumo.system.folders import cannot_write, check_own, replace_own
from merge_sumo.system.printable import printable
from merge_sumo.values.case import FloatArray, dimensions, to_unit
from merge_sumo.values.fmc import RADIUS, fmc
from merge_sumo.values.scenario import ALL_LEVELS, DEADLINE_S, DT_S, OWN, POV, VUT, level_name
from merge_sumo.values.score import FAILURE_SCORE, Outcome
from merge_sumo.values.trajectory import End, Trajectory

REPORT: Final = "report.html"
GENERATOR: Final = b'<meta name="generator" content="merge-sumo">'
"""By this a report is known as ours, and may be replaced by a newer one."""
HEAD_BYTES: Final = 1000
LISTED: Final = 10
"""Cases in a list, and messages of errors and timeouts."""
ERROR_CHARACTERS: Final = 2000
"""Of the message of a case; `outcomes.jsonl` has the whole."""
SHOWN: Final = 2000
"""Cases that the page holds one by one, with their motion; more are shown as counts."""
COUNT_GRID: Final = (32, 20)
SPEED_UNIT_MPS: Final = 0.002
"""Speeds are kept as whole numbers of this in 16 bits: up to 131 m/s, positions within 2 cm."""
GRID: Final = {2: (97, 97, 1), 3: (49, 49, 17)}
"""Nodes of the maps in x_POV0, v_POV0 and psi, by the level's number of dimensions."""
NEIGHBOURS: Final = 3
"""Cases of the truth that decide whether a node of the map fails."""
MOST_STEPS: Final = 40
"""Batches, or groups of batches, in the charts of the search."""
MOST_BALLS: Final = 20_000
"""Balls that are counted for a level's curve of coverage: of more failures it has fewer points."""


def write_report(run: Run) -> Path:
    """Write `report.html` into the folder of a run, in place of an older one; return its path.

    Raises `UserError` when it cannot be written, or what is there is no report of ours.
    """
    check_report(run.folder)
    path = run.folder / REPORT
    replace_own(path, report_page(run).encode(errors="backslashreplace"))
    return path


def check_report(folder: Path) -> None:
    """Raise `UserError` where `report.html` in a folder is something else than our report."""
    path = folder / REPORT
    check_own(path)
    try:
        with path.open("rb") as file:
            ours = GENERATOR in file.read(HEAD_BYTES)
    except FileNotFoundError:
        return
    except OSError as error:
        raise cannot_write(path, error) from error
    if not ours:
        raise UserError(f"{path} is no report of merge-sumo and is not replaced: move it away")


def report_page(run: Run) -> str:
    """Return the report of a run as HTML."""
    from jinja2 import Environment, PackageLoader
    from markupsafe import Markup

    loader = PackageLoader("merge_sumo.reports")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    style, script = (
        (Path(__file__).parent / "templates" / name).read_text(encoding="utf-8")
        for name in ("report.css", "report.js")
    )
    facts = _Facts(run)
    # No "<" in the JSON: nothing in it can end its element.
    data = json.dumps(facts.data(), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return environment.get_template("report.html.jinja").render(
        **facts.words(),
        style=Markup(style),  # noqa: S704 (our own file)
        script=Markup(script),  # noqa: S704 (our own file)
        style_hash=_policy_hash(style),
        script_hash=_policy_hash(script),
        data=Markup(data),  # noqa: S704 (JSON without "<")
        level_name=level_name,
    )


def _policy_hash(source: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(source.encode()).digest()).decode()


@dataclass(frozen=True, slots=True)
class _Level:
    """What the page says of a level; bars are shares of 100."""

    level: int
    name: str
    caption: str
    about: str
    cases: int
    failures: int
    untested: int
    share_bar: float
    untested_bar: float
    fmc: float | None
    fmc_bar: float | None
    plausible: float | None
    plausible_bar: float
    truth: float | None
    truth_bar: float
    note: str


ABOUT: Final = {
    0: "keeps its speed",
    1: "makes room for a VUT that accelerates",
    2: "expects a VUT that thinks; psi 0 is egoistic, pi/2 cares for the VUT",
}


class _Facts:
    """Everything that the page shows of a run."""

    def __init__(self, run: Run) -> None:
        levels = run.settings.get("levels")
        if not isinstance(levels, list) or any(level not in ALL_LEVELS for level in levels):
            raise UserError(f"{run.folder / SETTINGS} is no campaign's: it has no list of levels")
        self.run = run
        self.road = _road_of(run)
        self.summary = summarise(run.outcomes, levels)
        self.verdict = judge(run.outcomes)
        self.levels = list(self.summary.levels)
        self.worst = failures(run.outcomes)
        self.near = sorted(
            (o for o in run.outcomes if _is_told(o) and not o.failed),
            key=lambda o: (o.measures.score, o.index),
        )
        self.untested = [o for o in run.outcomes if not _is_told(o)]
        examples = [o for trouble in self._troubles() for o in self._examples(trouble)]
        listed = examples + self.worst[:LISTED] + self.near[:LISTED]
        telling = {o.index: o for o in (*listed, *self.worst, *self.untested, *self.near)}
        self.shown = sorted(list(telling.values())[:SHOWN], key=lambda outcome: outcome.index)
        self.motion = {o.index: motion for o in self.shown if (motion := _motion(run, o.index))}
        self.diagnoses: dict[int, Diagnosis] = {
            o.index: diagnose(self.motion[o.index], o.measures)
            for o in self.shown
            if o.index in self.motion
        }
        self.kinds: dict[int, Kind] = {
            index: found.kind for index, found in self.diagnoses.items() if found.kind is not None
        }
        self.surfaces = {level: learn_surface(run.outcomes, level) for level in self.levels}
        self.truths = {level: _truth(run, self.road, level) for level in self.levels}

    def words(self) -> dict[str, Any]:
        """Return what the template needs for text and tables."""
        settings, summary = self.run.settings, self.summary
        wanted = settings.get("cases")
        boxes = [
            box
            for level in self.levels
            for box in failure_boxes(self.worst + self.near, level, self.kinds)
        ]
        described = Counter(box.level for box in boxes for _ in range(box.failures))
        lost = [str(o.index) for o in self.shown if o.index not in self.motion]
        if len(lost) > LISTED:
            lost = [*lost[:LISTED], counted(len(lost) - LISTED, "other")]
        left = {n: summary.levels[n].failures - described[n] for n in self.levels}
        levels = self._levels()
        tables = [
            (f"{trouble.count} {trouble.end}: {trouble.message}", self._examples(trouble))
            for trouble in self._troubles()
        ]
        tables += [
            ("Ten worst failures", self.worst[:LISTED]),
            ("Ten nearest misses", self.near[:LISTED]),
        ]
        return {
            "vut": self.run.vut,
            "headline": headline(self.verdict, summary, self.worst, self.kinds),
            "counts": self.verdict.counts,
            "found": self.verdict,
            "troubles": self._troubles(),
            "more_troubles": self.verdict.troubles[LISTED:],
            "lost": in_words(lost) if lost else "",
            "torn": self.run.torn or (isinstance(wanted, int) and summary.cases < wanted),
            "counted": summary.cases - len(self.shown),
            "summary": summary,
            "levels": levels,
            "any_truth": any(level.truth is not None for level in levels),
            "truth_cases": " or ".join(
                f"{count:,}" for count in sorted({TRUTH_CASES[level] for level in self.levels})
            ),
            "plausible_chance": f"{PLAUSIBLE:.0%}",
            "fewest_failures": FEWEST_FAILURES,
            "avoidable": _avoidable(self.worst),
            "batches": len({o.batch for o in self.run.outcomes}),
            "driven": _duration(sum(o.measures.t_end_s for o in self.run.outcomes)),
            "sentences": [box.sentence for box in boxes],
            "scattered": ", ".join(
                f"{counted(count, 'failure')} at level {level_name(level)}"
                for level, count in left.items()
                if count > 0
            ),
            "kinds": self._kinds(),
            "ceded": f"{CEDED_MPS:g}",
            "scenario": self.run.scenario,
            "printed": end_of(self.run.folder / LOG),
            "tables": tables,
            "settings": {name: _shown(value) for name, value in settings.items() if value},
            "flat_settings": list(_flat(settings)),
            "other_net": settings.get("net_sha256") != self.road.sha256,
        }

    def _troubles(self) -> Sequence[Trouble]:
        """Return the errors and timeouts that are listed, by message."""
        return self.verdict.troubles[:LISTED]

    def _examples(self, trouble: Trouble) -> list[Outcome]:
        return [self.run.outcome(index) for index in trouble.cases[:LISTED]]

    def _levels(self) -> list[_Level]:
        plausible = {
            level: None if surface is None else surface.plausible_fmc()
            for level, surface in self.surfaces.items()
        }
        truth = {
            level: None if found is None else fmc(found.failures)
            for level, found in self.truths.items()
        }
        most_share = max(
            (
                (s.failures + s.cases - s.tested) / s.cases
                for s in self.summary.levels.values()
                if s.cases
            ),
            default=0.0,
        )

        def row(level: int, found: LevelSummary) -> _Level:
            # Found against what there may be: a bar shows nothing where only one of them is known.
            most = max(found.fmc, plausible[level] or 0.0, truth[level] or 0.0)
            known = plausible[level] is not None or truth[level] is not None
            scale = 90.0 / most if known and most > 0.0 else 0.0
            share = 100.0 / (most_share * found.cases) if most_share > 0.0 and found.cases else 0.0
            return _Level(
                level=level,
                name=level_name(level),
                caption=f"own: {self.run.pov}" if level == OWN else str(level),
                about=ABOUT.get(level, ""),
                cases=found.cases,
                failures=found.failures,
                untested=found.cases - found.tested,
                share_bar=round(share * found.failures, 1),
                untested_bar=round(share * (found.cases - found.tested), 1),
                fmc=found.fmc if found.tested else None,
                fmc_bar=round(scale * found.fmc, 1) if scale else None,
                plausible=plausible[level],
                plausible_bar=round(scale * (plausible[level] or 0.0), 1),
                truth=truth[level],
                truth_bar=round(scale * (truth[level] or 0.0), 1),
                note=self._note(level, found),
            )

        return [row(level, found) for level, found in self.summary.levels.items()]

    def _note(self, level: int, found: LevelSummary) -> str:
        if found.cases and not found.tested:
            return f"Nothing was tested in {counted(found.cases, 'case')}."
        text = f"{counted(found.failures, 'failure')} in {counted(found.cases, 'case')}"
        if found.failures:
            text += f", {counted(found.regions, 'region')}"
        if found.tested < found.cases:
            text += f"; {found.cases - found.tested} not tested"
        if self.surfaces[level] is None:
            text += f". No surrogate: it takes {FEWEST_FAILURES} failures to learn one"
        return text + "."

    def _kinds(self) -> list[dict[str, Any]]:
        found = Counter(self.kinds.values())
        avoidable = Counter(self.kinds[o.index] for o in self.worst if self._avoidable_kind(o))
        return [
            {
                "name": kind.value,
                "meaning": MEANING[kind],
                "count": count,
                "avoidable": avoidable[kind],
            }
            for kind, count in found.most_common()
        ]

    def _avoidable_kind(self, outcome: Outcome) -> bool:
        return outcome.index in self.kinds and bool(outcome.measures.avoidable)

    def data(self) -> dict[str, Any]:
        """Return what the script draws from: plain JSON."""
        speeds, offsets = _packed(self.motion)
        scenarios = self.run.folder / SCENARIOS
        return {
            "dt": DT_S,
            "crash_m": self.run.scenario.dx_crash_m,
            "radius": RADIUS,
            "level_names": {level: level_name(level) for level in ALL_LEVELS},
            "x_vut0_m": self.run.scenario.x_vut0_m,
            "speed_unit_mps": SPEED_UNIT_MPS,
            "dimensions": {
                name: [round(d.low, 4), round(d.high, 4)]
                for name, d in zip(("x", "v", "psi"), self.run.scenario.dimensions(2), strict=True)
            },
            "ends": [end.value for end in End],
            "kinds": [kind.value for kind in Kind],
            "cases": self._columns(offsets),
            "errors": {
                o.index: shortened(o.measures.error, ERROR_CHARACTERS)
                for o in self.shown
                if o.measures.error
            },
            "speeds": speeds,
            "counts": self._counts(),
            "chance": {
                level: None if surface is None else _chance_grid(surface, level)
                for level, surface in self.surfaces.items()
            },
            "truth": {
                level: None if truth is None else _truth_grid(truth, level)
                for level, truth in self.truths.items()
            },
            "search": self._search(),
            "commands": self._commands(),
            "export": f"merge-sumo export {_quoted(self.run.folder)}",
            "replay": f"merge-sumo replay {_quoted(scenarios / 'case-NNNNN')} --gui",
            **_road(self.road),
        }

    def _columns(self, offsets: Mapping[int, int]) -> dict[str, list[Any]]:
        ends, kinds = list(End), list(Kind)
        columns: dict[str, list[Any]] = {}
        for o in self.shown:
            found = self.diagnoses.get(o.index, Diagnosis(None, None, None))
            row = {
                "index": o.index,
                "level": o.case.level,
                "x": round(o.case.x_pov0_m, 3),
                "v": round(o.case.v_pov0_mps, 4),
                "psi": _rounded(o.case.svo_rad, 4),
                "end": ends.index(o.measures.end),
                "failed": int(o.failed),
                "score": _rounded(o.measures.score, 1),
                "dx": _rounded(o.measures.dx_m, 2),
                "dv": _rounded(o.measures.dv_mps, 2),
                "t_end": o.measures.t_end_s,
                "way_out": _rounded(o.measures.last_avoidable_s, 1),
                "vut_yields": found.vut_yields_s,
                "pov_yields": found.pov_yields_s,
                "kind": None if found.kind is None else kinds.index(found.kind),
                "offset": offsets.get(o.index, 0),
                "rows": len(self.motion[o.index].motion) if o.index in self.motion else 0,
            }
            for name, value in row.items():
                columns.setdefault(name, []).append(value)
        return columns or {"index": []}

    def _counts(self) -> dict[int, dict[str, Any]]:
        """Return how many cases that are not shown one by one lie where, by level."""
        shown = {o.index for o in self.shown}
        others = [o for o in self.run.outcomes if o.index not in shown]
        nx, ny = COUNT_GRID
        counts = {}
        for level in self.levels if others else ():
            grid: dict[str, Any] = {"nx": nx, "ny": ny}
            for name, failing in (("safe", False), ("failing", True)):
                at = [o for o in others if o.case.level == level and o.failed is failing]
                points = to_unit((o.case for o in at), level)[:, :2]
                cells, _, _ = np.histogram2d(
                    points[:, 1], points[:, 0], bins=(ny, nx), range=((0, 1), (0, 1))
                )
                grid[name] = cells.astype(int).ravel().tolist()
            counts[level] = grid
        return counts

    def _search(self) -> dict[str, Any]:
        """Return cases, mean score and coverage of each level after groups of batches."""
        batches = sorted({o.batch for o in self.run.outcomes})
        width = -(-len(batches) // MOST_STEPS) or 1
        groups = batches[::width]
        levels = []
        for level in self.levels:
            at = [o for o in self.run.outcomes if o.case.level == level]
            group = np.array([o.batch // width for o in at], dtype=np.int64)
            score = np.array([o.measures.score for o in at], dtype=np.float64)
            failed = np.array([o.failed for o in at], dtype=bool)
            points = to_unit((o.case for o in at), level)
            counted: list[int] = []
            means: list[float | None] = []
            covered: list[float | None] = []
            stride = -(-len(groups) * int(failed.sum()) // MOST_BALLS) or 1
            last = len(groups) - 1
            for number in range(len(groups)):
                inside = score[(group == number) & ~np.isnan(score)]
                counted.append(int((group == number).sum()))
                means.append(round(float(inside.mean()), 1) if len(inside) else None)
                so_far = points[failed & (group <= number)]
                wanted = (last - number) % stride == 0
                covered.append(round(fmc(so_far), 5) if wanted else None)
            levels.append({"level": level, "cases": counted, "score": means, "fmc": covered})
        return {"batch": groups, "width": width, "levels": levels}

    def _commands(self) -> dict[int, str]:
        """Return the commands that replay the cases that are exported already."""
        folder = self.run.folder / SCENARIOS
        return {
            o.index: f"merge-sumo replay {_quoted(folder / case_name(o.index))} --gui"
            for o in self.shown
            if (folder / case_name(o.index)).is_dir()
        }


def headline(
    verdict: Verdict, summary: Summary, worst: Sequence[Outcome], kinds: Mapping[int, Kind]
) -> str:
    """Return the result of a campaign in a few sentences: what was not tested comes first."""
    if not verdict.cases:
        return "No case has run."
    said = verdict.sentences
    if verdict.tested:
        for level, found in summary.levels.items():
            if found.cases and not found.tested:
                said.append(f"At POV level {level_name(level)} nothing was tested.")
        said.append(_collisions(verdict, summary, worst, kinds))
    return " ".join(said)


def _collisions(
    verdict: Verdict, summary: Summary, worst: Sequence[Outcome], kinds: Mapping[int, Kind]
) -> str:
    if not summary.failures:
        others = "the other " if verdict.tested < verdict.cases else ""
        return (
            f"No collision in {others}{counted(verdict.tested, 'case')}. That is no proof: the "
            "search saw these cases and no others."
        )
    failing = {level: found for level, found in summary.levels.items() if found.failures}
    tested = {level: found for level, found in summary.levels.items() if found.tested}
    never = [level_name(level) for level, found in tested.items() if not found.failures]
    parts = [
        f"{found.failures} of {found.cases} cases at POV level {level_name(level)} "
        f"({counted(found.regions, 'region')})"
        for level, found in failing.items()
    ]
    text = f"Collides in {in_words(parts)}"
    text += f", never at level {in_words(never)}." if never else "."
    common = Counter(kinds[o.index] for o in worst if o.index in kinds).most_common(1)
    if common:
        kind, count = common[0]
        share = "All are" if count == summary.failures else f"{count} of {summary.failures} are"
        text += f" {share} of the kind “{kind}”: {MEANING[kind]}."
    return text


def _is_told(outcome: Outcome) -> bool:
    return outcome.measures.end.is_tested and outcome.measures.score is not None


def _avoidable(worst: Sequence[Outcome]) -> str | None:
    if not worst:
        return None
    count = sum(bool(o.measures.avoidable) for o in worst)
    return f"{count} of {len(worst)} could have been avoided by the VUT."


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{seconds / 60.0:.1f} min"


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Any:
    """Yield (name, value) of settings, nested ones with their path."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name} ")
        else:
            yield _shown(f"{prefix}{name}"), _shown(value)


def _shown(value: object) -> str:
    """Return a setting as a text that is fit to be shown; it may be a stranger's."""
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return printable(text[:ERROR_CHARACTERS])


def _motion(run: Run, index: int) -> Trajectory | None:
    """Return the trajectory of a case; None where it is lost: the report goes without."""
    try:
        return run.trajectory(index)
    except UserError:
        return None


def _road_of(run: Run) -> Corridor:
    """Return the road of a run, or the shipped one to draw on where that is not there any more."""
    try:
        return road_for(run.scenario)
    except UserError:
        return road_of()


def _truth(run: Run, road: Corridor, level: int) -> Truth | None:
    """Return the ground truth that is cached for what this run tested, if there is one."""
    settings = run.settings
    same = (
        settings.get("net_sha256") == road.sha256
        and settings.get("versions") == versions()
        and settings.get("v_vut0_mps") == run.scenario.v_vut0_mps
    )
    if not same:
        return None
    kept = Kept(
        str(settings.get("vut")),
        level,
        TRUTH_CASES[level],
        0,
        settings.get("vut_command"),
        settings.get("deadline_s", DEADLINE_S),
        run.scenario,
        policies=settings.get("policies_sha256", {}),
        pov=settings.get("pov") if level == OWN else None,
    )
    return read_truth(kept.path(), level, kept.cases, kept.scenario)


def _packed(motion: Mapping[int, Trajectory]) -> tuple[str, dict[int, int]]:
    """Return the speeds of POV and VUT at every step in base64, and the first row of each case."""
    offsets, first = {}, 0
    parts = [np.empty((0, 2), dtype="<u2")]
    for index, trajectory in motion.items():
        speeds = trajectory.motion[:, (POV, VUT), 1]
        parts.append(np.rint(np.clip(speeds / SPEED_UNIT_MPS, 0, 65535)).astype("<u2"))
        offsets[index] = first
        first += len(speeds)
    return base64.b64encode(np.concatenate(parts).tobytes()).decode(), offsets


def _nodes(level: int) -> FloatArray:
    """Return the nodes of a level's map, (n, d), x_POV0 running fastest and psi slowest."""
    axes = [np.linspace(0.0, 1.0, n) for n in GRID[len(dimensions(level))] if n > 1]
    mesh = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack([axis.ravel() for axis in mesh[::-1]], axis=1)


def _grid(level: int, share: NDArray[Any]) -> dict[str, Any]:
    nx, ny, np_ = GRID[len(dimensions(level))]
    values = np.rint(255.0 * share).astype(np.uint8)
    return {"nx": nx, "ny": ny, "np": np_, "data": base64.b64encode(values.tobytes()).decode()}


def _chance_grid(surface: Surface, level: int) -> dict[str, Any]:
    return _grid(level, surface.chance(_nodes(level)))


def _truth_grid(truth: Truth, level: int) -> dict[str, Any]:
    from scipy.spatial import cKDTree

    _, near = cKDTree(truth.points).query(_nodes(level), k=NEIGHBOURS)
    return _grid(level, (truth.score < FAILURE_SCORE)[near].mean(axis=1))


def _road(road: Corridor) -> dict[str, Any]:
    """Return both paths as points (lane coordinate, x, y), and the lines of all lanes near M.

    M is the origin of the plane, and the road goes on to the right: a net may lie anywhere.
    """
    at = road.lane_point(0.0, on_ramp=False)
    ahead_x, ahead_y = math.sin(math.radians(at.angle_deg)), math.cos(math.radians(at.angle_deg))

    def place(x: float, y: float) -> list[float]:
        dx, dy = x - at.x_m, y - at.y_m
        along, left = dx * ahead_x + dy * ahead_y, dy * ahead_x - dx * ahead_y
        return [round(along, 2), round(left, 2)]

    def points(path: LanePath) -> list[list[float]]:
        return [
            [round(piece.start_m + share * piece.length_m, 2), *place(x, y)]
            for piece in path.pieces
            for share, (x, y, _) in zip(piece.shares, piece.shape, strict=True)
        ]

    shapes = [piece.shape for path in (road.mainline, road.ramp) for piece in path.pieces]
    lanes = [*road.surroundings, *dict.fromkeys(shapes)]
    return {
        "main": points(road.mainline),
        "ramp": points(road.ramp),
        "lanes": [[place(x, y) for x, y, _ in shape] for shape in lanes],
    }


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)

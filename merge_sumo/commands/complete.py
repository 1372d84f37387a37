"""Values that a shell completes: VUTs, levels, samplers, scenarios and run folders.

A shell asks for them in a process of its own; nothing is imported before it asks.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

LEVELS: Final = (("0", "keeps its speed"), ("1", "learned"), ("2", "learned, with psi"))
ENGINES: Final = (("kinematic", "eq. (4), a share of the cases in SUMO"), ("sumo", "SUMO alone"))
RUNS: Final = "runs"
"""Folder in which campaigns are, unless a person says otherwise."""
MOST_RUNS: Final = 50

Completions = list[tuple[str, str]]
"""Values with a help text each, which may be empty."""


def _matching(incomplete: str, values: Iterable[tuple[str, str]]) -> Completions:
    return [(value, about) for value, about in values if value.startswith(incomplete)]


def vuts(incomplete: str) -> Completions:
    """Return the VUTs by name, the kinds of one's own, and Python files in the folder."""
    from merge_sumo.vuts.python import installed_vuts
    from merge_sumo.vuts.registry import BUILT_IN_VUTS, KINDS

    if ":" in incomplete:
        return _matching(incomplete, _names_in(incomplete.rpartition(":")[0]))
    named = [(name, "built in") for name in BUILT_IN_VUTS]
    named += [(name, "installed") for name in installed_vuts()]
    named += [
        (_common_prefix(name, kind.form), kind.what) for name, kind in KINDS.items() if kind.form
    ]
    return _matching(incomplete, [*named, *_files(incomplete, (".py",), ":")])


def _common_prefix(name: str, form: str) -> str:
    """Return the common prefix of all specs of a kind."""
    return f"{name}:" if form.startswith(f"{name}:") else name


def _names_in(source: str) -> Completions:
    """Return the classes and functions of a Python file that may be a VUT; it is not run."""
    import ast

    path = Path(source)
    if path.suffix != ".py" or not path.is_file():
        return []
    try:
        body = ast.parse(path.read_text(encoding="utf-8")).body
    except (OSError, ValueError, SyntaxError):
        return []
    kinds = ast.ClassDef, ast.FunctionDef
    names = [node.name for node in body if isinstance(node, kinds) and node.name[:1] != "_"]
    return [(f"{source}:{name}", "") for name in names]


def _files(incomplete: str, suffixes: tuple[str, ...], behind: str = "") -> Completions:
    """Return the files of the folder that a text points into, and its folders."""
    typed = Path(incomplete)
    folder = typed if incomplete.endswith("/") else typed.parent
    try:
        entries = sorted(folder.iterdir())
    except OSError:
        return []
    shown = [entry for entry in entries if not entry.name.startswith(".")]
    files = [(f"{e}{behind}", "") for e in shown if e.suffix in suffixes and e.is_file()]
    return files + [(f"{e}/", "") for e in shown if e.is_dir() and str(e).startswith(incomplete)]


def levels(incomplete: str) -> Completions:
    """Return the POV levels, and all of them."""
    return [*one_level(incomplete), *_matching(incomplete, [("all", "every level")])]


def one_level(incomplete: str) -> Completions:
    """Return the POV levels."""
    return _matching(incomplete, [*LEVELS, ("own", "a POV of your own: --pov")])


def engines(incomplete: str) -> Completions:
    """Return what may move the vehicles of a study."""
    return _matching(incomplete, ENGINES)


def samplers(incomplete: str) -> Completions:
    """Return the samplers; after a comma those that are not named yet."""
    from merge_sumo.samplers.registry import SAMPLERS

    before = incomplete.rpartition(",")[0]
    front, named = (f"{before},", before.split(",")) if before else ("", [])
    return _matching(incomplete, [(f"{front}{name}", "") for name in SAMPLERS if name not in named])


def scenarios(incomplete: str) -> Completions:
    """Return the shipped scenarios, and TOML files."""
    from merge_sumo.road.scenario_file import shipped_scenarios

    shipped = [(name, "shipped") for name in shipped_scenarios()]
    return _matching(incomplete, [*shipped, *_files(incomplete, (".toml",))])


def traffics(incomplete: str) -> Completions:
    """Return the shipped traffics, and TOML files."""
    from merge_sumo.analysis.traffic import shipped_traffics

    shipped = [(name, "shipped") for name in shipped_traffics()]
    return _matching(incomplete, [*shipped, *_files(incomplete, (".toml",))])


def formats(incomplete: str) -> Completions:
    """Return the formats of an export."""
    from merge_sumo.reports.formats import FORMATS

    return _matching(incomplete, [(name, item.about) for name, item in FORMATS.items()])


def gates(incomplete: str) -> Completions:
    """Return what a gate may be."""
    known = (
        ("failures", "a case fails"),
        ("errors", "a case errs"),
        ("timeouts", "a case never ends"),
        ("regressions", "a case fails that passes with --against"),
    )
    return _matching(incomplete, [*known, ("fmc>", "coverage of failures above a number")])


def networks(incomplete: str) -> Completions:
    """Return the learned networks."""
    from merge_sumo.drivers.policies import NETWORKS

    return _matching(incomplete, [(name, "") for name in NETWORKS])


def runs(incomplete: str) -> Completions:
    """Return the folders of campaigns in `runs`, the newest first, and other folders."""
    from merge_sumo.campaigns.store import SETTINGS

    by_time = []
    for settings in Path(RUNS).glob(f"*/{SETTINGS}"):
        try:
            by_time.append((settings.stat().st_mtime, str(settings.parent)))
        except OSError:
            continue
    newest = [(folder, "campaign") for _, folder in sorted(by_time, reverse=True)[:MOST_RUNS]]
    known = {f"{folder}/" for folder, _ in newest}
    others = [entry for entry in _files(incomplete, ()) if entry[0] not in known]
    return _matching(incomplete, [*newest, *others])

"""The verbs that measure: truths, benchmarks of samplers, certificates, probabilities, training."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Unpack

from merge_sumo.api.recorded import AnyRun, opened
from merge_sumo.api.setup import (
    Hosting,
    Setup,
    check_keywords,
    no_check,
    recordable,
    settings_for,
)
from merge_sumo.api.study_results import (
    Benchmark,
    CertificateResult,
    CheckResult,
    ProbabilityResult,
    TruthResult,
)
from merge_sumo.campaigns.plan import plan_of
from merge_sumo.campaigns.settings import CampaignSettings, one_level, settings_of
from merge_sumo.drivers.policies import policies_in
from merge_sumo.engine.simulator import SimulationPlan, road_for
from merge_sumo.errors import Notice, UserError
from merge_sumo.reports.progress import Counter
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.studies import benchmark as experiments
from merge_sumo.studies import certificate, vut_check
from merge_sumo.studies import probability as estimates
from merge_sumo.studies.certificate_runs import runs_points_on
from merge_sumo.studies.truth import (
    DENSE_CASES,
    TRUTH_CASES,
    Truth,
    ground_truth,
    known_truth,
)
from merge_sumo.system.folders import check_new, dated
from merge_sumo.system.workers import Workers, open_workers
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB, level_name
from merge_sumo.vuts.base import VutOptions
from merge_sumo.vuts.in_memory import AnyVut, drivers_of, is_here
from merge_sumo.vuts.registry import vut_factory


def truth(
    vut: AnyVut,
    level: int | str,
    *,
    cases: int | None = None,
    seed: int = 0,
    workers: int | None = 1,
    dask: str | None = None,
    progress: bool | None = None,
    **setup: Unpack[Setup],
) -> Truth:
    """Return the ground truth of a VUT at one level; see `truths`, whose arguments these are."""
    check_keywords("truth", setup, Setup)
    settings, count = settings_for(vut, level, setup, workers=workers)
    number = one_level(str(level), settings.povs)
    return _truths(settings, count, cases, seed, dask, progress)[number]


def truths(
    vut: AnyVut,
    level: int | str = "all",
    *,
    cases: int | None = None,
    seed: int = 0,
    workers: int | None = 1,
    dask: str | None = None,
    progress: bool | None = None,
    **setup: Unpack[Setup],
) -> TruthResult:
    """Find the ground truth of a VUT by uniform cases; the same as `merge-sumo truth`.

    Args:
        vut: as of `campaign`.
        level: POV level 0, 1 or 2, "own" for a `pov`, or "all".
        cases: uniform cases of a level; by default 10,000, and 20,000 at level 2.
        seed: same seed, same cases.
        workers: processes that run cases; None is one a core.
        dask: address of a Dask scheduler whose workers run the cases instead.
        progress: show progress; by default in a notebook and on a terminal.
        setup: how a case is run and judged: see `Setup`.

    It comes from the cache where it is there. The truth of an object of this process, which a name
    does not tell from another, is not kept.
    """
    check_keywords("truths", setup, Setup)
    settings, count = settings_for(vut, level, setup, workers=workers)
    found = _truths(settings, count, cases, seed, dask, progress)
    if settings.vut_factory.vut.named_only and not is_here(settings.vut):
        warnings.warn(
            "note: nobody can tell what the program behind this VUT loads; this truth is kept for "
            "its command and the files that are named there",
            Notice,
            stacklevel=2,
        )
    return TruthResult(settings.vut, found, settings.criterion)


def _truths(
    settings: CampaignSettings,
    workers: int | None,
    cases: int | None,
    seed: int,
    dask: str | None,
    progress: bool | None,
) -> dict[int, Truth]:
    plan = plan_of(settings, road_for(settings.scenario))
    with (
        _cache_for(settings) as cache,
        open_workers(settings.workers(workers), dask) as there,
    ):
        return {
            level: _truth(plan, level, cases, seed, there, cache, progress)
            for level in settings.levels
        }


@contextmanager
def _cache_for(settings: CampaignSettings) -> Iterator[Path | None]:
    """Give the cache of truths; a passing one for objects, whose names say nothing elsewhere."""
    if not (is_here(settings.vut) or is_here(settings.pov or "")):
        yield None
        return
    with tempfile.TemporaryDirectory(prefix="merge-sumo-") as passing:
        yield Path(passing)


def _truth(
    plan: SimulationPlan,
    level: int,
    cases: int | None,
    seed: int,
    workers: Workers,
    cache: Path | None,
    progress: bool | None,
) -> Truth:
    total = TRUTH_CASES[level] if cases is None else cases
    title = f"truth of {plan.vut.spec} at level {level_name(level)}"
    with Counter(title, total, "cases", shown=progress) as counter:
        return ground_truth(
            *(plan, level, total, seed), workers=workers, cache=cache, on_cases=counter.ended
        )


def compare(
    vut: AnyVut,
    level: int | str = "all",
    *,
    samplers: Sequence[str] | None = None,
    seeds: int = 10,
    cases: int = 400,
    batch: int | None = None,
    truth_cases: int | None = None,
    dense: bool | None = None,
    workers: int | None = 1,
    dask: str | None = None,
    progress: bool | None = None,
    **setup: Unpack[Setup],
) -> Benchmark:
    """Compare samplers with each other and with the ground truth; as `merge-sumo compare`.

    Args:
        vut: as of `campaign`.
        level: POV level 0, 1 or 2, "own" for a `pov`, or "all", over which coverage is summed.
        samplers: their names; all by default.
        seeds: runs of each sampler.
        cases: cases of each run.
        batch: cases per batch; by default 20, and what it wants for `coverage`.
        truth_cases: cases of the truth at a level; by default 10,000, and 20,000 at level 2.
        dense: make the dense truths of 1,000,000 cases, or go without; by default those kept.
        workers: processes that run cases; None is one a core.
        dask: address of a Dask scheduler whose workers run the cases instead.
        progress: show progress; by default in a notebook and on a terminal.
        setup: how a case is run and judged: see `Setup`.

    Raises `UserError` for values that make no comparison.
    """
    check_keywords("compare", setup, Setup)
    names = list(
        dict.fromkeys(name.strip() for name in (SAMPLERS if samplers is None else samplers))
    )
    if not names:
        raise UserError(f"name at least one sampler: {', '.join(SAMPLERS)}")
    settings, count = settings_for(
        *(vut, level, setup), workers=workers, sampler=names[0], cases=cases, batch=batch
    )
    for name in names[1:]:
        replace(settings, sampler=name)
    if seeds < 1:
        raise UserError(f"--seeds is {seeds}: it must be 1 or more")
    plan = plan_of(settings, road_for(settings.scenario))
    title = f"{settings.vut} v level {'/'.join(map(level_name, settings.levels))}"
    with (
        _cache_for(settings) as cache,
        open_workers(settings.workers(count), dask) as there,
        Counter(title, len(names) * seeds, "runs", shown=progress) as counter,
    ):
        found = {
            number: _truth(plan, number, truth_cases, 0, there, cache, progress)
            for number in settings.levels
        }
        dense_truths = _dense(plan, settings.levels, there, cache, dense, progress)
        searches = experiments.search(
            plan,
            settings.levels,
            names,
            seeds=seeds,
            cases=cases,
            batch=batch,
            workers=there,
            on_search=lambda name, _: counter.ended(1, name),
        )
    limit = experiments.limit_fmc(chain.from_iterable(searches.values()), found, dense_truths)
    return Benchmark(
        samplers={name: experiments.compare(s, found, limit) for name, s in searches.items()},
        truths=found,
        dense=dense_truths,
        limit_fmc=limit,
        oracle_fmc=experiments.oracle(found, cases, batch),
        cases=cases,
    )


def _dense(
    plan: SimulationPlan,
    levels: Sequence[int],
    workers: Workers,
    cache: Path | None,
    wanted: bool | None,
    progress: bool | None,
) -> dict[int, Truth]:
    """Return the dense truths by level: made where they are `wanted`, else those that are kept."""
    if wanted is False:
        return {}
    if wanted:
        return {
            level: _truth(plan, level, DENSE_CASES, 0, workers, cache, progress) for level in levels
        }
    known = {level: known_truth(plan, level, DENSE_CASES, cache=cache) for level in levels}
    return {level: one for level, one in known.items() if one is not None}


def certify(
    vut: AnyVut,
    level: int | str = "all",
    *,
    radius: float = 0.01,
    net: Path | str | None = None,
    out: Path | str | None = None,
    resume: bool = False,
    workers: int | None = 1,
    dask: str | None = None,
    check: Callable[[], None] | None = None,
    progress: bool | None = None,
    **setup: Unpack[Setup],
) -> CertificateResult:
    """Certify that no ball of a radius in the pool fails throughout; as `merge-sumo certify`.

    Args:
        vut: as of `campaign`.
        level: POV level 0, 1 or 2, "own" for a `pov`, or "all".
        radius: radius of the balls, as a share of the axes of the pool.
        net: SUMO net to use instead of the scenario's.
        out: new folder to write; `runs/certify-<vut>-<date>` by default.
        resume: go on with the certificate in `out`.
        workers: processes that run cases; None is one a core.
        dask: address of a Dask scheduler whose workers run the cases instead.
        check: called after every block of cases; may raise to stop there.
        progress: show progress; by default in a notebook and on a terminal.
        setup: how a case is run and judged: see `Setup`.

    Raises `UserError` for values that make no certificate, and when the folder exists.
    """
    check_keywords("certify", setup, Setup)
    settings, count = settings_for(vut, level, setup, workers=workers)
    lattices = certificate.lattices_of(settings, radius)
    if resume and out is None:
        raise UserError("say with out= which folder is resumed")
    folder = dated(f"certify-{settings.vut}") if out is None else Path(out)
    if not resume:
        check_new(folder)
    road = road_for(settings.scenario, None if net is None else Path(net))
    title = f"{settings.vut} v level {'/'.join(map(level_name, settings.levels))}"
    with (
        open_workers(settings.workers(count), dask) as there,
        Counter(title, sum(map(len, lattices.values())), "cases", shown=progress) as counter,
    ):
        done = certificate.certify(
            settings,
            radius,
            folder,
            road,
            runs_points_on(there, settings, road, folder),
            resume=resume,
            on_cases=counter.ended,
            check=check or no_check,
        )
    return CertificateResult(done, folder / certificate.CERTIFICATE)


def probability(
    run: AnyRun,
    *,
    cases: int = estimates.DEFAULT_CASES,
    distribution: Path | str | None = None,
    confidence: float = 0.95,
    seed: int = 0,
    net: Path | str | None = None,
    out: Path | str | None = None,
    trust_vut: bool = False,
    workers: int = 1,
    dask: str | None = None,
    progress: bool | None = None,
    **hosting: Unpack[Hosting],
) -> ProbabilityResult:
    """Estimate how likely the VUT of a campaign is to fail; as `merge-sumo probability`.

    Args:
        run: the campaign, or its folder.
        cases: fresh cases to run.
        distribution: JSON file that says how often cases occur; uniform by default.
        confidence: chance that the interval holds the probability.
        seed: same seed, same cases.
        net: net for that; must be the one of the campaign.
        out: new file to write; `probability.json` in the folder of the campaign by default.
        trust_vut: run the controller that a folder names although it was not made here.
        workers: processes that run cases.
        dask: address of a Dask scheduler whose workers run the cases instead.
        progress: show progress; by default in a notebook and on a terminal.
        hosting: settings that may be otherwise: `policies`, `pov`, `vut_command`, `deadline_s`,
            `vut_memory_gib`, `in_process`; see `Setup`.

    Raises `UserError` for another net or POV than recorded, and when the file exists.
    """
    check_keywords("probability", hosting, Hosting)
    before = opened(run).run
    target = before.folder / estimates.RESULT if out is None else Path(out)
    _, pov, count = drivers_of(before.vut, hosting.get("pov"), workers)
    given = recordable({**hosting, **({} if pov is None else {"pov": pov})})
    settings = settings_of(before.folder, before.settings, given, trust=trust_vut)
    with (
        open_workers(settings.workers(count), dask) as there,
        Counter("fresh cases", cases, "cases", shown=progress) as counter,
    ):
        found = estimates.failure_probability(
            before,
            target,
            cases=cases,
            distribution=None if distribution is None else Path(distribution),
            confidence=confidence,
            seed=seed,
            net=road_for(before.scenario, None if net is None else Path(net)),
            given=given,
            trust=trust_vut,
            workers=there,
            on_case=lambda _: counter.ended(1),
        )
    return ProbabilityResult(found, target, before.criterion, distribution is None)


def check_vut(vut: AnyVut, **hosting: Unpack[Hosting]) -> CheckResult:
    """Let a VUT drive a few cases and say what is wrong with it; as `merge-sumo check-vut`.

    Args:
        vut: as of `campaign`.
        hosting: `policies`, `vut_command`, `deadline_s`, `vut_memory_gib`, `in_process`; see
            `Setup`.
    """
    check_keywords("check_vut", hosting, Hosting)
    spec, _, _ = drivers_of(vut, None, 1)
    policies = hosting.get("policies")
    options = VutOptions(
        command=hosting.get("vut_command"),
        deadline_s=hosting.get("deadline_s", DEADLINE_S),
        memory_gib=hosting.get("vut_memory_gib", MEMORY_GIB),
        in_process=hosting.get("in_process", False),
        policies=None if policies is None else policies_in(policies),
    )
    return CheckResult(spec, vut_check.check_vut(vut_factory(spec, options)))

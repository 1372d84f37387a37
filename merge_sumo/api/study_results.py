"""What the studies return: a truth, a benchmark of samplers, a certificate, a probability."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Final

from merge_sumo.analysis.result import Result
from merge_sumo.analysis.verdict import counted
from merge_sumo.studies.benchmark import Quartiles, SamplerSummary
from merge_sumo.studies.certificate import Certificate
from merge_sumo.studies.interval import Estimate
from merge_sumo.studies.truth import DENSE_CASES, REAL_REGION, Truth
from merge_sumo.studies.vut_check import VutCheck
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.fmc import fmc, regions
from merge_sumo.values.scenario import level_name

NAMED: Final = 5
"""Failures of a level of a certificate that are printed; the certificate names more."""


@dataclass(frozen=True, repr=False)
class TruthResult(Result):
    """The ground truth of a VUT at one or more POV levels.

    Attributes:
        vut: the VUT.
        truths: `Truth` by level: `points` in the unit cube, (n, d), their `score`, (n,), and the
            points of the `failures`, (m, d).
        criterion: what counts as a failure.
    """

    vut: str
    truths: dict[int, Truth]
    criterion: Criterion

    @property
    def cases(self) -> int:
        """Number of cases, over all levels."""
        return sum(len(truth.score) for truth in self.truths.values())

    @property
    def failures(self) -> int:
        """Number of failures, over all levels."""
        return sum(len(truth.failures) for truth in self.truths.values())

    @property
    def fmc(self) -> float:
        """Failure mode coverage, summed over the levels."""
        return sum(fmc(truth.failures) for truth in self.truths.values())

    @property
    def real_regions(self) -> int:
        """Number of failing regions with at least 3 % of the failures of their level."""
        return sum(len(truth.real_regions()) for truth in self.truths.values())

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints: that of the level, or sums with a list of the levels."""
        records = [
            {
                "vut": self.vut,
                "level": level,
                "cases": len(truth.score),
                "failures": len(truth.failures),
                "fmc": fmc(truth.failures),
                "region_sizes": _region_sizes(truth),
                "real_regions": len(truth.real_regions()),
                "fail_when": self.criterion.text,
            }
            for level, truth in self.truths.items()
        ]
        if len(records) == 1:
            return records[0]
        sums = {name: getattr(self, name) for name in ("cases", "failures", "fmc", "real_regions")}
        text = self.criterion.text
        return {"vut": self.vut, "level": "all", **sums, "fail_when": text, "levels": records}

    def lines(self) -> list[str]:
        """Return a line for each level, and any criterion but the default one in words."""
        said = [
            f"{self.vut} at level {level_name(level)}: {len(truth.failures)} failures in "
            f"{len(truth.score)} cases, FMC {fmc(truth.failures):.4f}, "
            f"{len(truth.real_regions())} regions with at least {REAL_REGION:.0%} of the failures"
            for level, truth in self.truths.items()
        ]
        if not self.criterion.is_papers:
            said.append(f"  a case fails when {self.criterion.words}")
        return said


def _region_sizes(truth: Truth) -> list[int]:
    labels = regions(truth.failures).tolist()
    return [labels.count(label) for label in range(max(labels, default=-1) + 1)]


HEADINGS: Final = (
    *("FMC / truth", "FMC / limit", "FMC", "failures", "regions"),
    *("to 50 %", "to 90 %", "sampler s"),
)


@dataclass(frozen=True, repr=False)
class Benchmark(Result):
    """Samplers beside each other, and beside the ground truth, over several seeds.

    Attributes:
        samplers: `SamplerSummary` by name: medians and quartiles over the seeds.
        truths: the truth by level.
        dense: the dense truth by level, where one is known.
        limit_fmc: coverage of all that truth and searches found, or of the dense truths.
        oracle_fmc: coverage of an oracle by number of cases.
        cases: cases of each search.
    """

    samplers: dict[str, SamplerSummary]
    truths: dict[int, Truth]
    dense: dict[int, Truth]
    limit_fmc: float
    oracle_fmc: dict[int, float]
    cases: int

    @property
    def truth_fmc(self) -> float:
        """Failure mode coverage of the truth, summed over the levels."""
        return sum(fmc(found.failures) for found in self.truths.values())

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        first = next(iter(self.samplers.values()))
        return {
            "truth_fmc": self.truth_fmc,
            "limit_fmc": self.limit_fmc,
            "dense_levels": list(self.dense),
            "oracle_fmc_by_batch": [self.oracle_fmc[n] for n in first.cases_by_batch],
            **{name: asdict(result) for name, result in self.samplers.items()},
        }

    def lines(self) -> list[str]:
        """Return truth, limit and oracle, and a table of the samplers."""
        failures = sum(len(found.failures) for found in self.truths.values())
        real = sum(len(found.real_regions()) for found in self.truths.values())
        return [
            f"truth: FMC {self.truth_fmc:.4f}, {failures} failures, {real} regions",
            f"limit: FMC {self.limit_fmc:.4f}, {limit_of(self.dense, list(self.truths))}",
            f"oracle: FMC {self.oracle_fmc[self.cases]:.4f} with {self.cases} cases",
            *_table(self.samplers),
        ]


def limit_of(dense: Collection[int], levels: Sequence[int]) -> str:
    """Return in words what the limit is the coverage of, with dense truths at some levels."""
    if not dense:
        return "of all that truth and searches found (--dense runs 1,000,000 cases)"
    where = "" if len(dense) == len(levels) else " at some levels"
    return f"of {DENSE_CASES:,} uniform cases{where}, or of all that was found, where that is more"


def _table(compared: Mapping[str, SamplerSummary]) -> list[str]:
    """Return a line per sampler: medians, with the quartiles in brackets."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, caption=r"medians \[quartiles]", caption_justify="left")
    table.add_column("sampler")
    for heading in HEADINGS:
        table.add_column(heading, justify="right", no_wrap=True)
    for name, found in compared.items():
        table.add_row(
            name,
            _spread(found.fmc_over_truth_median, found.fmc_over_truth_quartiles, ".3f"),
            _spread(found.fmc_over_limit_median, found.fmc_over_limit_quartiles, ".3f"),
            _spread(found.fmc_median, found.fmc_quartiles, ".4f"),
            _spread(found.failures_median, found.failures_quartiles, ".0f"),
            _spread(found.regions_found_median, found.regions_found_quartiles, ".1f"),
            _spread(found.cases_to_50_percent_median, found.cases_to_50_percent_quartiles, ".0f"),
            _spread(found.cases_to_90_percent_median, found.cases_to_90_percent_quartiles, ".0f"),
            f"{found.sampler_s_median:.2f}",
        )
    text = StringIO()
    # As wide as it is: a line of a table that is read by a program must not be broken.
    Console(width=200, highlight=False, soft_wrap=True, file=text).print(table)
    return [line.rstrip() for line in text.getvalue().splitlines()]


def _spread(median: float | None, quartiles: Quartiles, form: str) -> str:
    median_text, low, high = (
        "-" if value is None else f"{value:{form}}" for value in (median, *quartiles)
    )
    return f"{median_text} [{low}, {high}]"


@dataclass(frozen=True, repr=False)
class CertificateResult(Result):
    """A certificate that is complete.

    Attributes:
        certificate: `levels` by level, `radius` and `sentence`.
        file: `certificate.json` in its folder.
    """

    certificate: Certificate
    file: Path

    @property
    def certain(self) -> bool:
        """Whether no ball of the radius fails throughout."""
        return self.certificate.certain

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        done = self.certificate
        levels = {level: asdict(found) for level, found in done.levels.items()}
        told = {"certain": done.certain, "sentence": done.sentence, "radius": done.radius}
        return {**told, "levels": levels, "file": str(self.file)}

    def lines(self) -> list[str]:
        """Return the sentence, and the worst failures by level."""
        said = [self.certificate.sentence]
        for level, found in self.certificate.levels.items():
            if found.failures or found.untold:
                said.append(
                    f"  level {level_name(level)}: {found.failures:,} failures and "
                    f"{found.untold:,} without a verdict in {found.cases:,} cases"
                )
            for case in found.worst[:NAMED]:
                named = ", ".join(f"{name} {value:.4g}" for name, value in case.items())
                said.append(f"    {named}")
        return [*said, f"certificate: {self.file}"]


@dataclass(frozen=True, repr=False)
class ProbabilityResult(Result):
    """How likely a VUT is to fail.

    Attributes:
        estimate: `probability`, ends `low` and `high` of the interval, and what they rest on.
        file: file that was written.
        criterion: what counts as a failure.
        is_uniform: whether all cases of the pool are equally likely.
    """

    estimate: Estimate
    file: Path
    criterion: Criterion
    is_uniform: bool

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {**asdict(self.estimate), "file": str(self.file)}

    def lines(self) -> list[str]:
        """Return the probability, its interval, and that of the plain cases."""
        found, arm = self.estimate, self.estimate.uniform_arm
        how = "under uniform cases" if self.is_uniform else "under the stated distribution"
        said = [
            f"P(fail) {how}: {found.probability:.3g}, {100.0 * found.confidence:g} % interval "
            f"[{found.low:.3g}, {found.high:.3g}] ({counted(found.failures, 'failure')} in "
            f"{found.cases} fresh cases)"
        ]
        if not self.criterion.is_papers:
            said.append(f"  a case fails when {self.criterion.words}")
        if found.without_verdict:
            said.append(
                f"  {found.without_verdict} cases without a verdict: safe for the lower end, "
                "failures for the upper end"
            )
        return [
            *said,
            f"  for comparison, the {arm.cases} plain cases among them alone: {arm.failures} "
            f"failures, [{arm.low:.3g}, {arm.high:.3g}]",
            f"written: {self.file}",
        ]


@dataclass(frozen=True, repr=False)
class CheckResult(Result):
    """What `check_vut` found wrong with a VUT.

    Attributes:
        vut: the VUT.
        found: `problems`, `notes`, and the cost of a step in microseconds.
    """

    vut: str
    found: VutCheck

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.found.problems

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {"vut": self.vut, "ok": self.ok, **asdict(self.found)}

    def lines(self) -> list[str]:
        """Return what is wrong in sentences, and what a step costs."""
        found = self.found
        return [
            *(found.problems or ["nothing wrong"]),
            *(f"note: {sentence}" for sentence in found.notes),
            f"a step costs {found.us_per_step_median:.0f} us (median), "
            f"{found.us_per_step_worst:.0f} us at worst",
        ]

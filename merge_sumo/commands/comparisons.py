"""How `compare` prints what samplers found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from merge_sumo.campaigns.experiments import Comparison, Quartiles
    from merge_sumo.campaigns.truth import Truth

HEADINGS: Final = (
    *("FMC / truth", "FMC / limit", "FMC", "failures", "regions"),
    *("to 50 %", "to 90 %", "sampler s"),
)


def truths_of(
    levels: Sequence[int], find: Callable[[int], Truth | None] | None
) -> dict[int, Truth]:
    """Return the truths that somebody finds, by level."""
    found = {level: find(level) for level in levels} if find is not None else {}
    return {level: truth for level, truth in found.items() if truth is not None}


def limit_of(dense: Collection[int], levels: Sequence[int]) -> str:
    """Return in words what the limit is the coverage of, with dense truths at some levels."""
    from merge_sumo.campaigns.truth import DENSE_CASES

    if not dense:
        return "of all that truth and searches found (--dense runs 1,000,000 cases)"
    where = "" if len(dense) == len(levels) else " at some levels"
    return f"of {DENSE_CASES:,} uniform cases{where}, or of all that was found, where that is more"


def print_comparisons(compared: dict[str, Comparison]) -> None:
    """Print a line per sampler: medians, with the quartiles in brackets."""
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
    # As wide as it is: a line of a table that is read by a program must not be broken.
    Console(width=200, highlight=False, soft_wrap=True).print(table)


def _spread(median: float | None, quartiles: Quartiles, form: str) -> str:
    median_text, low, high = (
        "-" if value is None else f"{value:{form}}" for value in (median, *quartiles)
    )
    return f"{median_text} [{low}, {high}]"

"""Who proposes the next cases: `ask(n)` gives cases, `tell(outcomes)` takes what came of them."""

from typing import Final

DEFAULT_SAMPLER: Final = "coverage"
"""The sampler of a campaign that names none; here, where it costs no import."""

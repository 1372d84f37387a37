"""Who proposes the next cases: `ask(n)` gives cases, `tell(outcomes)` takes what came of them."""

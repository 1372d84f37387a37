"""Plain values: a scenario, a case, what happened, how it is scored, how much of the pool fails."""

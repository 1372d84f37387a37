"""From a plan and cases to results: the only place where cases run."""

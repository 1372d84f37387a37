"""Who drives a car: level-k drivers, rule-based controllers, and what a user brings."""

"""VUTs that a user brings: one file for each kind, and what the kinds share in `base`."""

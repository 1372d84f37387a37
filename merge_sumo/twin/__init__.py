"""A twin of the VUT: what it will do, learned from what it did, and its rollouts."""

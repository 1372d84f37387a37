"""Questions that take simulations: each leaves a file that reports read."""

"""Training of the POV library: rewards, environments, DDQN, the helix, and what proves them."""

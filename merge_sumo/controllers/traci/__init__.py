"""A TraCI server for the controller of a user, in which SUMO decides."""

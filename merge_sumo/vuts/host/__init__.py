"""A process of its own for the code of a user."""

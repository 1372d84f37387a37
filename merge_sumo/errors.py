"""What a person did that we cannot go on with: one sentence that says what to do."""

from __future__ import annotations


class UserError(Exception):
    """Bad input or a missing part of the installation; the command line prints it and exits 2."""

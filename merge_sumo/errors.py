"""What a person did that we cannot go on with: one sentence that says what to do."""

from __future__ import annotations


class UserError(Exception):
    """Bad input or a missing part of the installation; the command line prints it and exits 2."""

    def __init__(self, sentence: str) -> None:
        """Take the sentence; messages of libraries that are part of it may have several lines."""
        super().__init__(" ".join(sentence.splitlines()))

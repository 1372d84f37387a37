"""Weigh the package and the tests: tokens of each room, against a budget.

    python tools/weight.py            print the table; end with 1 where a room is above its budget
    python tools/weight.py --lower    write today's weights as the budget; the sums only go down

A token is one of Python's tokenizer without comments, newlines and indentation. Lines are free: a
loop of four lines is easier to read than a comprehension in a call. The budget is in
`tools/weight.json`: a room that grows takes from another one in the same change.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tokenize
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
BUDGET = Path(__file__).with_suffix(".json")
LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}
Weights = dict[str, int]


def weight_of(path: Path) -> int:
    """Return the tokens of a file."""
    with path.open("rb") as file:
        return sum(token.type not in LAYOUT for token in tokenize.tokenize(file.readline))


def room_of(path: Path) -> str:
    """Return the folder below the package or the tests in which a file stands."""
    return "/".join(path.parts[: min(2, len(path.parts) - 1)])


def weights() -> Weights:
    """Return the tokens of each room, of all files that git tracks, and the sums."""
    listed = ["git", "-C", str(ROOT), "ls-files", "merge_sumo/*.py", "tests/*.py"]
    rooms: Weights = defaultdict(int)
    for name in subprocess.run(listed, check=True, capture_output=True, text=True).stdout.split():
        path = Path(name)
        if (ROOT / path).exists():
            tokens = weight_of(ROOT / path)
            rooms[room_of(path)] += tokens
            rooms[f"{path.parts[0]} in all"] += tokens
    return dict(sorted(rooms.items()))


def main() -> None:
    """Print the weights next to the budget."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--lower", action="store_true", help="write today's weights as the budget")
    lower = parser.parse_args().lower
    now = weights()
    budget: Weights = json.loads(BUDGET.read_text())
    heavy = []
    print(f"{'room':<24} {'tokens':>8} {'budget':>8}")
    for room, tokens in now.items():
        allowed = budget.get(room, 0)
        print(f"{room:<24} {tokens:>8} {allowed:>8}")
        # A move between rooms is free when the budget is written again, growth never is.
        if tokens > allowed and (room.endswith(" in all") or not lower):
            heavy.append(f"{room}: {tokens} tokens, {allowed} allowed")
    if lower and not heavy:
        BUDGET.write_text(json.dumps(now, indent=1) + "\n")
    for sentence in heavy:
        print(sentence, file=sys.stderr)
    sys.exit(bool(heavy))


if __name__ == "__main__":
    main()

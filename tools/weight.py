"""Weigh the package and the tests: lines and tokens of each room, against a budget.

    python tools/weight.py            print the table; end with 1 where a room is above its budget
    python tools/weight.py --lower    write the weights of today as the budget, where they are less

A token is one of Python's tokenizer without comments, newlines and indentation. The budget, in
`tools/weight.json`, only goes down: a room that grows takes from another one in the same change.
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
Weights = dict[str, dict[str, int]]


def weight_of(path: Path) -> tuple[int, int]:
    """Return the lines and the tokens of a file."""
    with path.open("rb") as file:
        tokens = sum(token.type not in LAYOUT for token in tokenize.tokenize(file.readline))
    return len(path.read_bytes().splitlines()), tokens


def room_of(path: Path) -> str:
    """Return the folder below the package or the tests in which a file stands."""
    return "/".join(path.parts[: min(2, len(path.parts) - 1)])


def weights() -> Weights:
    """Return lines and tokens by room, of all files that git tracks, and the sums."""
    listed = ["git", "-C", str(ROOT), "ls-files", "merge_sumo/*.py", "tests/*.py"]
    rooms: Weights = defaultdict(lambda: {"lines": 0, "tokens": 0})
    for name in subprocess.run(listed, check=True, capture_output=True, text=True).stdout.split():
        path = Path(name)
        if not (ROOT / path).exists():
            continue
        lines, tokens = weight_of(ROOT / path)
        for room in {room_of(path), f"{path.parts[0]} in all"}:
            rooms[room]["lines"] += lines
            rooms[room]["tokens"] += tokens
    return dict(sorted(rooms.items()))


def main() -> None:
    """Print the weights beside the budget."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--lower", action="store_true", help="lower the budget to today's weights")
    lower = parser.parse_args().lower
    now: Weights = weights()
    budget: Weights = json.loads(BUDGET.read_text()) if BUDGET.exists() else {}
    heavy = []
    print(f"{'room':<24} {'lines':>7} {'budget':>7} {'tokens':>8} {'budget':>8}")
    for room, weight in now.items():
        allowed = budget.get(room, weight)
        print(
            f"{room:<24} {weight['lines']:>7} {allowed['lines']:>7} "
            f"{weight['tokens']:>8} {allowed['tokens']:>8}"
        )
        heavy += [
            f"{room}: {weight[unit]} {unit}, {allowed[unit]} allowed"
            for unit in ("lines", "tokens")
            if weight[unit] > allowed[unit]
        ]
    if lower:
        lowered = {
            room: {unit: min(weight[unit], budget.get(room, weight)[unit]) for unit in weight}
            for room, weight in now.items()
        }
        BUDGET.write_text(json.dumps(lowered, indent=1) + "\n")
    for sentence in heavy:
        print(sentence, file=sys.stderr)
    sys.exit(bool(heavy) and not lower)


if __name__ == "__main__":
    main()

"""Compare tokens of each folder and frames of the stack with a budget.

    python tools/weight.py            print the table; end with 1 if a folder is above its budget
    python tools/weight.py --lower    write the present weights as the budget; the sums only go down

A token is one of Python's tokenizer without comments, newlines and indentation. Lines are free: a
loop of four lines is easier to read than a comprehension in a call. The budget is in
`tools/weight.json`: a folder that grows takes from another folder in the same change. Frames are
the frames of the package below the `act` of a controller of a user in a campaign.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import tokenize
from collections import defaultdict
from pathlib import Path
from types import FrameType

import merge_sumo as ms

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
FRAMES = "frames under act"
Weights = dict[str, int]


def weight_of(path: Path) -> int:
    """Return the tokens of a file.

    Args:
        path: the file.
    """
    with path.open("rb") as file:
        return sum(token.type not in LAYOUT for token in tokenize.tokenize(file.readline))


def room_of(path: Path) -> str:
    """Return the folder of a file below the package or the tests.

    Args:
        path: path of the file in the checkout.
    """
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


class FrameCounter:
    """A controller that counts the frames of the package on the stack when it decides."""

    most = 0

    def act(self, _: ms.Seen) -> float:
        """Accelerate, and keep the largest number of frames."""
        frame: FrameType | None = sys._getframe()
        frames = 0
        while frame is not None:
            frames += Path(frame.f_code.co_filename).is_relative_to(ROOT / "merge_sumo")
            frame = frame.f_back
        FrameCounter.most = max(FrameCounter.most, frames)
        return 1.0


def frames_under_act() -> int:
    """Return how many frames of the package lie below a controller that decides in a campaign."""
    with tempfile.TemporaryDirectory() as folder:
        ms.campaign(FrameCounter, cases=3, level=1, workers=1, out=Path(folder) / "run")
    return FrameCounter.most


def main() -> None:
    """Print the weights next to the budget."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--lower", action="store_true", help="write the weights as the budget")
    lower = parser.parse_args().lower
    now = {**weights(), FRAMES: frames_under_act()}
    budget: Weights = json.loads(BUDGET.read_text())
    heavy = []
    print(f"{'room':<24} {'tokens':>8} {'budget':>8}")
    for room, tokens in now.items():
        allowed = budget.get(room, 0)
        print(f"{room:<24} {tokens:>8} {allowed:>8}")
        # A move between rooms is free when the budget is written again, growth never is.
        never_grows = room.endswith(" in all") or room == FRAMES
        if tokens > allowed and (never_grows or not lower):
            heavy.append(f"{room}: {tokens}, {allowed} allowed")
    if lower and not heavy:
        BUDGET.write_text(json.dumps(now, indent=1) + "\n")
    for sentence in heavy:
        print(sentence, file=sys.stderr)
    sys.exit(bool(heavy))


if __name__ == "__main__":
    main()

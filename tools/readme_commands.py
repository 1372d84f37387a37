"""Print the commands of README, so that CI runs what a person reads: one per line.

python tools/readme_commands.py            all commands in ```sh blocks, in order
python tools/readme_commands.py "Install"  only those under that heading
"""

from __future__ import annotations

import sys
from pathlib import Path

README = Path(__file__).resolve().parent.parent / "README.md"


def commands(text: str, heading: str | None = None) -> list[str]:
    """Return the commands in ```sh blocks, without comments, of all headings or of one."""
    found: list[str] = []
    current, in_block = "", False
    for line in text.splitlines():
        if line.startswith("```"):
            in_block = line.strip() == "```sh"
        elif in_block:
            command = line.split("  #")[0].strip()
            if command and not command.startswith("#") and heading in (None, current):
                found.append(command)
        elif line.startswith("#"):
            current = line.lstrip("#").strip()
    return found


if __name__ == "__main__":
    wanted = sys.argv[1] if len(sys.argv) > 1 else None
    printed = commands(README.read_text(encoding="utf-8"), wanted)
    if not printed:
        sys.exit(f"README has no ```sh commands under {wanted!r}")
    print("\n".join(printed))

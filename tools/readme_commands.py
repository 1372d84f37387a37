"""Print the commands of the site, of README and of CONTRIBUTING, one per line: CI runs them.

python tools/readme_commands.py            all commands in ```sh blocks, in order
python tools/readme_commands.py "Install"  only those under that heading

The pages come in the order of the site's navigation (`mkdocs.yml`), then README, then
CONTRIBUTING, which runs the tests. A ```bash block is for commands that CI cannot run as they are:
`tests/docs/test_tutorials.py` runs those of the start page.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LAST = (ROOT / "README.md", ROOT / "CONTRIBUTING.md")


def pages() -> list[Path]:
    """Return the pages in docs/ in the order of the navigation, then README and CONTRIBUTING."""
    _, nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n")
    named = [ROOT / "docs" / name for name in re.findall(r"[\w/-]+\.md", nav)]
    return [*(page for page in named if page.is_file()), *LAST]


def commands(text: str, heading: str | None = None) -> list[str]:
    """Return the commands in ```sh blocks, without comments.

    Args:
        text: a page.
        heading: heading of the blocks; None for all.
    """
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
    printed = [one for page in pages() for one in commands(page.read_text("utf-8"), wanted)]
    if not printed:
        sys.exit(f"no page has ```sh commands under {wanted!r}")
    print("\n".join(printed))

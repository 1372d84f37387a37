"""Write the files and the script of docs/how-to/ci.md for the CI of a controller.

python tools/ci_snippets.py github FOLDER    the commands of the GitHub workflow, one per line
python tools/ci_snippets.py gitlab FOLDER    the commands of the GitLab job

The script writes the files of the page, a controller and its test, into the new folder FOLDER.
`.ci/run` runs the commands there with the built wheel, which tests the page. Commands of `apt-get`
are left out: they need root, and `.ci/run` installs the same packages itself.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import yaml

PAGE = Path(__file__).resolve().parent.parent / "docs" / "how-to" / "ci.md"
TITLED = re.compile(r'^```\w+ title="([^"]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)
GITHUB, GITLAB = ".github/workflows/merge.yml", ".gitlab-ci.yml"


def files(text: str) -> dict[str, str]:
    """Return the files that a page shows, by name: blocks with a title.

    Args:
        text: the page.
    """
    return dict(TITLED.findall(text))


def commands(kind: str, text: str) -> list[str]:
    """Return the commands of the GitHub workflow or the GitLab job of a page.

    Args:
        kind: "github" or "gitlab".
        text: the page.
    """
    shown = files(text)
    if kind == "github":
        (job,) = yaml.safe_load(shown[GITHUB])["jobs"].values()
        return _lines(step["run"] for step in job["steps"] if "run" in step)
    (job,) = yaml.safe_load(shown[GITLAB]).values()
    return _lines([*job.get("before_script", ()), *job["script"]])


def _lines(scripts: Any) -> list[str]:
    lines = [line for script in scripts for line in str(script).splitlines()]
    return [line for line in lines if line.strip() and "apt-get" not in line]


def main(kind: str, folder: Path) -> None:
    """Write the files of the page, and print the commands.

    Args:
        kind: "github" or "gitlab".
        folder: new folder of the files.
    """
    text = PAGE.read_text(encoding="utf-8")
    folder.mkdir(parents=True)
    for name, content in files(text).items():
        if not name.startswith("."):
            (folder / name).write_text(content, encoding="utf-8")
    print("\n".join(commands(kind, text)))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))

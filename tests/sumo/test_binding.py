"""SUMO's programs where shared libraries of the system are missing."""

from __future__ import annotations

from pathlib import Path

import pytest

from merge_sumo.errors import UserError
from merge_sumo.sumo import binding

LOADER = (
    "{name}: error while loading shared libraries: libX11.so.6: cannot open shared object file: "
    "No such file or directory"
)
"""What the loader of glibc writes before it exits with 127."""


@pytest.mark.skipif(not Path("/bin/sh").exists(), reason="needs a shell")
@pytest.mark.parametrize("limit_s", [15.0, None], ids=["with a limit", "with a window"])
def test_a_program_without_its_libraries_names_the_packages(monkeypatch, tmp_path, limit_s):
    program = tmp_path / "bin" / "sumo"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\necho '{LOADER.format(name=program)}' >&2\nexit 127\n")
    program.chmod(0o755)
    monkeypatch.setattr(binding, "sumo_program", lambda name: str(program))
    with pytest.raises(UserError) as raised:
        binding.run_program("sumo", [], tmp_path, limit_s)
    assert f"apt-get install -y {binding.DEBIAN_PACKAGES}" in str(raised.value)
    assert "\n" not in str(raised.value)
    assert "libX11.so.6: cannot open" in str(raised.value)

"""What the package brings keeps its contracts; that of samplers is run in their room."""

from __future__ import annotations

import pytest
from build_fmu import build_fmu, compiler
from conftest import require, some
from support.networks import constant_network

from merge_sumo.testing import VutContract

VUTS = (
    "level0",
    "level2",
    "design2",
    "careful",
    "gap",
    "sumo:IDM",
    "python",
    "batched",
    "onnx",
    "fmu",
)
WISHES = """
import numpy as np
class Each:
    def act(self, seen):
        return 0.5, seen.may_merge and seen.x_vut_m > -30.0
class All:
    def __init__(self, corridors):
        pass
    def act_batch(self, seen):
        return np.full(len(seen.t_s), 0.5), seen.may_merge & (seen.x_vut_m > -30.0)
"""


@pytest.fixture(scope="module")
def spec_of(tmp_path_factory):
    """Return a function that gives the spec of one of `VUTS`; those of a user state wishes."""
    folder = tmp_path_factory.mktemp("vuts")

    def spec(name: str) -> str:
        if name in ("python", "batched"):
            (folder / "wishes.py").write_text(WISHES)
            return f"{folder / 'wishes.py'}:{'Each' if name == 'python' else 'All'}"
        if name == "fmu":
            pytest.importorskip("fmpy")
            require(compiler() is not None, "gcc is not on the PATH")
            path = folder / "wishes.fmu"
            return f"fmu:{path if path.exists() else build_fmu(path, merge='boolean')}"
        if name == "onnx":
            return f"onnx:{constant_network(folder / 'wishes.onnx', answer=[0.5, 1.0])}"
        return name

    return spec


class TestVuts(VutContract):
    @pytest.fixture(autouse=True, params=some(VUTS, "design2", "gap", "sumo:IDM", "python"))
    def _subject(self, request, spec_of):
        self.vut = spec_of(request.param)

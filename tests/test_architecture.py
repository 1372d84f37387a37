"""Which module may import which, and a few things that no module may do; read from the sources."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "merge_sumo"

LAYERS = (
    *("scenario", "metrics", "road", "drivers", "sumo", "controllers", "simulation", "samplers"),
    *("campaigns", "analysis", "training", "reports", "testing"),
)
"""The rooms, from the ground up: each imports from itself and from those before it."""
ONLY_IN = {
    "road": {"sumolib"},
    "sumo": {"libsumo", "traci", "sumo"},
    "training": {"torch", "gymnasium"},
    "": {"cyclopts", "merge_sumo.cli", "merge_sumo.console"},
    "nowhere": {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal", "yaml", "xml"},
}
"""Modules that one room alone imports ("" is the command line); readers that run code, or expand
entities as `xml` does, are imported nowhere."""
HEAVY_MODULES = {"numpy", "scipy", "sklearn", "libsumo", "torch"}
SIMULATING = {
    f"merge_sumo.{room}" for room in ("sumo", "drivers", "controllers", "simulation", "training")
}
REPORTS_READ = {
    "merge_sumo.drivers.reference_drivers.REFERENCE_DRIVERS",  # names of the reference drivers
    "merge_sumo.sumo.opendrive.opendrive",  # writes files for other simulators
    "merge_sumo.controllers.process.LOG",  # the end of what a controller printed
    "merge_sumo.controllers.process.end_of",
}
"""Values of rooms that simulate which reports read."""
MODULE_IN_A_STRING = re.compile(r"^(merge_sumo(?:\.\w+)+)(?::\w+)?$")


def module_of(file: Path) -> str:
    """Return the dotted name of a file of the package."""
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


MODULES = {module_of(file): file for file in PACKAGE.rglob("*.py") if "shipped" not in file.parts}


@cache
def all_nodes_of(module: str) -> list[ast.AST]:
    return list(ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))))


def nodes_of(module: str, *kinds: type[ast.AST]) -> list[Any]:
    """Return the nodes of some kinds in a module."""
    return [node for node in all_nodes_of(module) if isinstance(node, kinds)]


@cache
def imports_of(module: str) -> set[str]:
    """Return the dotted names that a module imports: by statement, by a call, by a string."""
    found: set[str] = set()
    for node in all_nodes_of(module):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Call) and called(node) == "import_module":
            found |= {str(arg.value) for arg in node.args if isinstance(arg, ast.Constant)}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found |= set(MODULE_IN_A_STRING.findall(node.value))
    return found


def called(node: ast.Call) -> str:
    """Return the last name of the function of a call."""
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def room_of(module: str) -> str:
    """Return the folder of a module in the package; "" for a file next to the folders."""
    package, _, rest = module.partition(".")
    room = rest.partition(".")[0]
    return room if package == "merge_sumo" and room in LAYERS else ""


def rooms_of(names: Iterable[str]) -> set[str]:
    return {room_of(name) for name in names}


def imports_any(module: str, libraries: set[str]) -> set[str]:
    """Return which imported names are one of some libraries, or inside of it."""
    found = set()
    for name in imports_of(module):
        if any(f"{name}.".startswith(f"{library}.") for library in libraries):
            found.add(name)
    return found


class TestImports:
    @pytest.mark.parametrize("room", ONLY_IN)
    def test_of_libraries_are_in_their_room_alone(self, room):
        importing = [module for module in MODULES if imports_any(module, ONLY_IN[room])]
        assert rooms_of(importing) == ({room} if room != "nowhere" else set())

    def test_go_down_the_layers(self):
        for module in MODULES:
            if room := room_of(module):
                allowed = {"", *LAYERS[: LAYERS.index(room) + 1]}
                assert rooms_of(imports_of(module)) <= allowed, module

    def test_of_files_make_no_circle(self):
        graph = {}
        for module in MODULES:
            graph[module] = (imports_of(module) & MODULES.keys()) - {module, "merge_sumo"}
        TopologicalSorter(graph).prepare()  # which raises CycleError

    def test_are_known_for_every_folder_of_the_package(self):
        folders = {path.parent.name for path in PACKAGE.glob("*/*.py")}
        assert folders == set(LAYERS)

    def test_of_a_report_open_no_simulation(self):
        for module in MODULES:
            if room_of(module) == "reports":
                values = imports_any(module, SIMULATING) - MODULES.keys()
                assert values <= REPORTS_READ, module

    def test_of_a_command_are_the_api_what_prints_and_names_for_the_help(self):
        registry = "merge_sumo.samplers.registry"
        names = imports_of("merge_sumo.cli") - {registry, f"{registry}.SAMPLERS"}
        assert rooms_of(names) == {""}

    def test_of_the_package_and_its_command_line_load_nothing_heavy(self):
        script = "import sys, merge_sumo.cli; dir(merge_sumo); print('\\n'.join(sys.modules))"
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=True
        )
        loaded = {name.split(".")[0] for name in done.stdout.split()}
        assert "merge_sumo" in loaded
        assert loaded & HEAVY_MODULES == set()


def test_xml_is_read_without_entities():
    for module in MODULES:
        for call in nodes_of(module, ast.Call):
            name = ast.unparse(call.func)
            options = {option.arg: ast.unparse(option.value) for option in call.keywords}
            if name == "etree.XMLParser":
                assert options.get("resolve_entities") == "False", module
            if name in ("etree.parse", "etree.fromstring", "etree.XML", "etree.iterparse"):
                given = len(call.args) == 2 or {"parser", "resolve_entities"} & options.keys()
                assert given, f"{module}: {name} without a parser"


def test_files_are_removed_and_renamed_in_one_module():
    removers = {"rmtree", "rmdir", "unlink", "removedirs", "rename", "renames", "move"}
    removing = set()
    for module in MODULES:
        for call in nodes_of(module, ast.Call):
            if called(call) in removers or ast.unparse(call.func) in ("os.remove", "os.replace"):
                removing.add(module)
    assert removing == {"merge_sumo.files"}


def test_no_file_and_no_function_is_longer_than_a_reader_can_hold():
    """Lines of docstrings of classes and functions do not count."""
    for module, file in MODULES.items():
        rest = len(file.read_text(encoding="utf-8").splitlines())
        for node in nodes_of(module, ast.ClassDef, ast.FunctionDef):
            docstring = len((ast.get_docstring(node) or "").splitlines())
            rest -= docstring
            lines = node.end_lineno - node.lineno + 1 - docstring
            assert isinstance(node, ast.ClassDef) or lines <= 60, f"{module}.{node.name}"
        assert rest <= 650, module


def test_no_two_classes_have_one_name():
    names = []
    for module in MODULES:
        names += [node.name for node in nodes_of(module, ast.ClassDef)]
    assert [name for name, count in Counter(names).items() if count > 1] == []


FLAG = re.compile(r"^[^-].*[ (`]--[a-z]")
"""A flag behind a word: what begins with one is an argument of a program."""
A_COMMAND = re.compile(r"(?:merge-sumo|pip|netconvert) ")


def test_no_message_of_a_room_names_a_flag():
    """A message names a field in backticks; a command turns it into its flag."""
    for module in MODULES:
        if room_of(module) in ("", "sumo"):
            continue
        inner = {node.value for node in nodes_of(module, ast.Expr)}  # docstrings
        for node in nodes_of(module, ast.JoinedStr):
            inner |= set(node.values)
        for node in nodes_of(module, ast.JoinedStr, ast.Constant):
            text = ast.unparse(node).lstrip("f'\" ")
            if node not in inner and FLAG.search(text):
                assert A_COMMAND.search(text), f"{module}: {text}"

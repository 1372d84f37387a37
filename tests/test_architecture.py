"""Which module may import which, and a few things that no module may do; read from the sources."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "merge_sumo"
FILES = sorted(path for path in PACKAGE.rglob("*.py") if "shipped" not in path.parts)

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
    "merge_sumo.drivers.reference.REFERENCES",  # names of the reference drivers
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


MODULES = {module_of(file): file for file in FILES}


@cache
def nodes_of(file: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))


@cache
def imports_of(file: Path) -> set[str]:
    """Return the dotted names that a file imports: by statement, by a call, by a string."""
    found = set()
    for node in nodes_of(file):
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
    """Return the last name of what is called."""
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def calls_in(file: Path) -> list[ast.Call]:
    return [node for node in nodes_of(file) if isinstance(node, ast.Call)]


def room_of(module: str) -> str:
    """Return the folder of a module in the package; "" for a file beside the folders."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and parts[0] == "merge_sumo" and parts[1] in LAYERS else ""


def imports_any(file: Path, modules: set[str]) -> set[str]:
    """Return which imported names are one of the modules, or inside of it."""
    return {
        name
        for name in imports_of(file)
        if any(f"{name}.".startswith(f"{module}.") for module in modules)
    }


class TestImports:
    @pytest.mark.parametrize("room", ONLY_IN)
    def test_of_libraries_are_in_their_room_alone(self, room):
        importing = {module_of(file) for file in FILES if imports_any(file, ONLY_IN[room])}
        elsewhere = {module for module in importing if room_of(module) != room}
        assert elsewhere == set()
        assert importing or room == "nowhere", "the check itself sees imports"

    def test_go_down_the_layers(self):
        for file in FILES:
            if room := room_of(module_of(file)):
                allowed = {"", *LAYERS[: LAYERS.index(room) + 1]}
                assert {room_of(name) for name in imports_of(file)} <= allowed, file

    def test_of_files_make_no_circle(self):
        graph = {
            name: (imports_of(file) & MODULES.keys()) - {name, "merge_sumo"}
            for name, file in MODULES.items()
        }
        TopologicalSorter(graph).prepare()  # which raises CycleError

    def test_are_known_for_every_folder_of_the_package(self):
        folders = {file.relative_to(PACKAGE).parts[0] for file in FILES if file.parent != PACKAGE}
        assert folders == set(LAYERS)

    def test_of_a_report_open_no_simulation(self):
        for file in FILES:
            if room_of(module_of(file)) == "reports":
                values = imports_any(file, SIMULATING) - set(MODULES)
                assert values <= REPORTS_READ, file

    def test_of_a_command_are_the_api_and_what_prints(self):
        assert {room_of(name) for name in imports_of(PACKAGE / "cli.py")} == {""}

    def test_of_the_command_line_load_nothing_heavy(self):
        script = "import sys, merge_sumo.cli; print('\\n'.join(sys.modules))"
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=True
        )
        loaded = {name.split(".")[0] for name in done.stdout.split()}
        assert "merge_sumo" in loaded
        assert loaded & HEAVY_MODULES == set()


def test_xml_is_read_without_entities():
    found = []
    for file in FILES:
        for call in calls_in(file):
            name = ast.unparse(call.func)
            options = {option.arg: ast.unparse(option.value) for option in call.keywords}
            if name == "etree.XMLParser" and options.get("resolve_entities") != "False":
                found.append(f"{file}: {name} without resolve_entities=False")
            reads = name in ("etree.parse", "etree.fromstring", "etree.XML", "etree.iterparse")
            if reads and len(call.args) < 2 and not {"parser", "resolve_entities"} & options.keys():
                found.append(f"{file}: {name} without a parser")
    assert found == []


def test_files_are_removed_and_renamed_in_two_modules():
    removers = {"rmtree", "rmdir", "unlink", "removedirs", "rename", "renames", "move"}
    removing = set()
    for module, file in MODULES.items():
        for call in calls_in(file):
            if called(call) in removers or ast.unparse(call.func) in ("os.remove", "os.replace"):
                removing.add(module)
    assert removing == {"merge_sumo.files"}


def test_no_file_and_no_function_is_longer_than_a_reader_can_hold():
    long = []
    for module, file in MODULES.items():
        if len(file.read_text(encoding="utf-8").splitlines()) > 700:
            long.append(module)
        for node in nodes_of(file):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                docstring = len((ast.get_docstring(node) or "").splitlines())
                if (node.end_lineno or 0) - node.lineno + 1 - docstring > 60:
                    long.append(f"{module}.{node.name}")
    assert long == []


def test_no_two_classes_have_one_name():
    modules = defaultdict(list)
    for module, file in MODULES.items():
        for node in nodes_of(file):
            if isinstance(node, ast.ClassDef):
                modules[node.name].append(module)
    assert {name: known for name, known in modules.items() if len(known) > 1} == {}


FLAG = re.compile(r"^[^-].*[ (`]--[a-z]")
"""A flag behind a word: what begins with one is an argument of a program."""
A_COMMAND = re.compile(r"(?:merge-sumo|pip|netconvert) ")


def test_no_message_of_a_room_names_a_flag():
    """A message names a field in backticks; a command turns it into its flag."""
    found = []
    for module, file in MODULES.items():
        if room_of(module) in ("", "sumo"):
            continue
        inner = {node.value for node in nodes_of(file) if isinstance(node, ast.Expr)}
        for node in nodes_of(file):
            if isinstance(node, ast.JoinedStr):
                inner |= set(node.values)
        for node in nodes_of(file):
            if isinstance(node, ast.JoinedStr | ast.Constant) and node not in inner:
                text = ast.unparse(node).lstrip("f'\" ")
                if FLAG.search(text) and not A_COMMAND.search(text):
                    found.append(f"{module}: {text}")
    assert found == []

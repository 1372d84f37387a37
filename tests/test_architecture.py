"""Who may import whom, and a few things that no file may do; read from the sources."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "merge_sumo"
FILES = sorted(path for path in PACKAGE.rglob("*.py") if "shipped" not in path.parts)

SUMO_MODULES = {"libsumo", "sumolib", "traci", "sumo"}
LEARNING_MODULES = {"torch", "gymnasium"}
UNSAFE_MODULES = {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal", "yaml", "xml"}
"""Readers that run code, or (xml, of the standard library) expand entities."""
LISTENERS = {
    *("bind", "create_server", "start_server", "TCPServer", "ThreadingTCPServer", "Listener"),
    *("HTTPServer", "ThreadingHTTPServer"),
}
LOOPBACK = {"127.0.0.1", "::1"}
HEAVY_MODULES = {"numpy", "scipy", "sklearn", "libsumo", "torch"}


LAYERS = (
    *("scenario", "metrics", "road", "drivers", "sumo", "controllers", "simulation", "samplers"),
    *("campaigns", "analysis", "training", "reports", "testing"),
)
"""The rooms, from the ground up: each imports from itself and from those before it."""


def layer_of(module: str) -> str:
    """Return the folder of a module in the package; nothing for a file beside the folders."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and (PACKAGE / parts[1] / "__init__.py").exists() else ""


def module_of(file: Path) -> str:
    """Return the dotted name of a file of the package."""
    parts = list(file.relative_to(PACKAGE.parent).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


IN_A_TEXT = re.compile(
    r"(?:\bimport|\bfrom)\s+(merge_sumo(?:\.\w+)*)(?:\s+import\s+(\w+))?"
    r"|^(merge_sumo(?:\.\w+)+)(?::\w+)?$"
)
"""An import in the text of a string, or a string that is the name of a module (and function)."""


@cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(source)))


def calls_in(source: str) -> list[ast.Call]:
    return [node for node in nodes_of(source) if isinstance(node, ast.Call)]


def imports(source: str, module: str = "merge_sumo.here", *, is_package: bool = False) -> set[str]:
    """Return the dotted names that a source imports, at any depth.

    By statement, by a call with a name, and by a string of this package: the text of a program, or
    the name of a module.
    """
    found = set()
    prose = {node.value for node in nodes_of(source) if isinstance(node, ast.Expr)}
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".")[: None if is_package else -1]
                above = package[: len(package) - node.level + 1]
                base = ".".join([*above, base] if base else above)
            found |= {base} | {f"{base}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and called(node) in IMPORTERS:
            names = [arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant)]
            found |= {str(name) for name in names}
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in prose:
            for base, name, alone in IN_A_TEXT.findall(node.value):
                found |= {alone or base, f"{base}.{name}" if name else alone or base}
    return found


IMPORTERS = ("import_module", "__import__")
IMPORTED_BY_A_VARIABLE = {
    "merge_sumo": "the room of a public name that is asked for",
    "merge_sumo.spawning": "the function that a new process of this package is to run",
    "merge_sumo.controllers.built_in": "the files of `drivers/`, which may have VUTs",
    "merge_sumo.controllers.python": "the module of a user's VUT",
}
"""Files that import what a variable names, and what that is."""


def imports_a_variable(source: str) -> bool:
    """Return whether a source imports a module whose name is no literal."""
    return any(
        called(call) in IMPORTERS and not isinstance(call.args[0], ast.Constant)
        for call in calls_in(source)
    )


def import_graph() -> dict[str, set[str]]:
    """Return the files of the package that each imports, by their dotted names.

    Every import of a file is one of the package, too, which is no file of a room.
    """
    modules = {name: file for file in FILES if (name := module_of(file)) != "merge_sumo"}
    return {
        module: {name for name in imports_of(file) if name in modules} - {module}
        for module, file in modules.items()
    }


def circle_in(graph: dict[str, set[str]]) -> list[str]:
    """Return files of which each imports the next and the last the first; [] where none do."""
    done: set[str] = set()

    def search(path: list[str]) -> list[str]:
        for name in sorted(graph.get(path[-1], ())):
            if name in path:
                return path[path.index(name) :]
            if name not in done and (circle := search([*path, name])):
                return circle
        done.add(path[-1])
        return []

    return next((circle for name in sorted(graph) if (circle := search([name]))), [])


def called(node: ast.Call) -> str:
    """Return the last name of what is called."""
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def imports_any(found: set[str], modules: set[str]) -> set[str]:
    """Return which of the imported names are one of the modules or inside of it."""
    return {name for name in found for m in modules if name == m or name.startswith(f"{m}.")}


@cache
def imports_of(file: Path) -> set[str]:
    is_package = file.name == "__init__.py"
    return imports(file.read_text(encoding="utf-8"), module_of(file), is_package=is_package)


def unsafe_calls(source: str) -> list[str]:
    """Return the calls that would run a shell, or code that hides in data."""
    found = []
    for node in calls_in(source):
        options = {option.arg: option.value for option in node.keywords}
        shell = options.get("shell")
        if shell is not None and not (isinstance(shell, ast.Constant) and shell.value is False):
            found.append(f"line {node.lineno}: shell")
        if called(node) in ("eval", "exec", "system", "popen"):
            found.append(f"line {node.lineno}: {called(node)}")
        if ast.unparse(node.func) in ("np.load", "numpy.load"):
            allowed = options.get("allow_pickle")
            if not (isinstance(allowed, ast.Constant) and allowed.value is False):
                found.append(f"line {node.lineno}: np.load without allow_pickle=False")
    return found


REMOVERS = {"rmtree", "rmdir", "unlink", "removedirs", "rename", "renames", "move"}
MAY_REMOVE = {"merge_sumo.files", "merge_sumo.scratch"}
"""The first asks what is ours; the second removes temporary folders of ours that no process locks;
the third removes what was unpacked for it."""


def removals(source: str) -> list[str]:
    """Return the calls that remove or rename files."""
    return [
        f"line {node.lineno}: {called(node)}"
        for node in calls_in(source)
        if called(node) in REMOVERS or ast.unparse(node.func) in ("os.remove", "os.replace")
    ]


def entity_calls(source: str) -> list[str]:
    """Return the calls that read XML and may follow an entity that it names."""
    found = []
    for node in calls_in(source):
        name = ast.unparse(node.func)
        if not name.startswith("etree."):
            continue
        options = {option.arg: option.value for option in node.keywords}
        makes_parser = name.removeprefix("etree.") in ("XMLParser", "iterparse", "XMLPullParser")
        resolve = options.get("resolve_entities")
        safe = isinstance(resolve, ast.Constant) and resolve.value is False
        if makes_parser and not safe:
            found.append(f"line {node.lineno}: {name} without resolve_entities=False")
        reads = name.removeprefix("etree.") in ("parse", "fromstring", "XML", "fromstringlist")
        if reads and len(node.args) < 2 and "parser" not in options:
            found.append(f"line {node.lineno}: {name} without a parser")
    return found


def open_listeners(source: str) -> list[str]:
    """Return the calls that listen on an address which is not loopback, as far as one can see."""
    constants = {
        target.id: node.value.value
        for node in nodes_of(source)
        if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(node.value, ast.Constant)
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if isinstance(target, ast.Name)
    }
    found = []
    for node in calls_in(source):
        if called(node) in LISTENERS and node.args:
            address = node.args[0]
            host = address.elts[0] if isinstance(address, ast.Tuple) and address.elts else address
            value = host.value if isinstance(host, ast.Constant) else None
            if isinstance(host, ast.Name):
                value = constants.get(host.id)
            if value not in LOOPBACK:
                found.append(f"line {node.lineno}: {ast.unparse(node)}")
    return found


def files_below(*folders: str) -> list[Path]:
    return [file for file in FILES if file.relative_to(PACKAGE).parts[0] in folders]


def offenders(files: list[Path], modules: set[str]) -> dict[str, set[str]]:
    """Return the files that import one of the modules, with what they import."""
    found = {module_of(file): imports_any(imports_of(file), modules) for file in files}
    return {module: names for module, names in found.items() if names}


SIMULATING = ("sumo", "drivers", "controllers", "simulation", "training")
"""The rooms that take part in a simulation. Reports read: what they need of these are values."""
REPORTS_READ = {
    "merge_sumo.drivers.reference.REFERENCES",  # names of the reference drivers
    "merge_sumo.sumo.opendrive.opendrive",  # writes files for other simulators
    "merge_sumo.sumo.replay_folder.write_scenario",
    "merge_sumo.controllers.process.LOG",  # the end of what a controller printed
    "merge_sumo.controllers.process.end_of",
}


class TestImports:
    def test_of_sumo_are_only_in_the_sumo_folder(self):
        others = [file for file in FILES if file not in files_below("sumo")]
        assert offenders(others, SUMO_MODULES) == {}
        assert offenders(files_below("sumo"), SUMO_MODULES), "the check itself sees imports"

    def test_go_down_the_layers(self):
        above = {}
        for file in FILES:
            room = layer_of(module_of(file))
            if not room:
                continue
            allowed = {*LAYERS[: LAYERS.index(room) + 1], ""}
            ours = imports_any(imports_of(file), {"merge_sumo"})
            if wrong := {name for name in ours if layer_of(name) not in allowed}:
                above[module_of(file)] = wrong
        assert above == {}

    def test_of_files_make_no_circle(self):
        assert circle_in(import_graph()) == []

    def test_of_what_a_variable_names_are_known(self):
        files = {module_of(f) for f in FILES if imports_a_variable(f.read_text(encoding="utf-8"))}
        assert files == set(IMPORTED_BY_A_VARIABLE)

    def test_are_known_for_every_folder_of_the_package(self):
        folders = {f.relative_to(PACKAGE).parts[0] for f in FILES if f.parent != PACKAGE}
        assert folders == set(LAYERS)

    def test_of_a_report_open_no_simulation(self):
        simulating = {f"merge_sumo.{room}" for room in SIMULATING}
        others = {
            module_of(file): {
                name
                for name in imports_any(imports_of(file), simulating)
                if not any(f"{value}.".startswith(f"{name}.") for value in REPORTS_READ)
            }
            for file in files_below("reports")
        }
        assert {module: names for module, names in others.items() if names} == {}

    def test_of_learning_libraries_are_only_in_the_training_folder(self):
        others = [file for file in FILES if file not in files_below("training")]
        assert offenders(others, LEARNING_MODULES) == {}

    def test_of_the_command_line_are_nobodys_but_its_own(self):
        line = {PACKAGE / "cli.py", PACKAGE / "console.py"}
        others = [file for file in FILES if file not in line]
        assert offenders(others, {"merge_sumo.cli", "merge_sumo.console", "cyclopts"}) == {}

    def test_of_a_command_are_the_api_and_what_prints(self):
        rooms = {layer_of(name) for name in imports_of(PACKAGE / "cli.py")}
        assert rooms == {""}

    def test_of_a_vut_are_of_sumo_in_its_own_models_and_its_traci_server_alone(self):
        of_sumo = ("merge_sumo.controllers.sumo_model", "merge_sumo.controllers.traci")
        importing = offenders(files_below("controllers"), {"merge_sumo.sumo"})
        assert importing
        assert {module for module in importing if not module.startswith(of_sumo)} == set()

    def test_unpickle_nothing(self):
        assert offenders(FILES, UNSAFE_MODULES) == {}

    def test_of_the_command_line_load_nothing_heavy(self):
        script = "import sys, merge_sumo.cli; print('\\n'.join(sys.modules))"
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=True
        )
        loaded = {name.split(".")[0] for name in done.stdout.split()}
        assert "merge_sumo" in loaded
        assert loaded & HEAVY_MODULES == set()


@pytest.mark.parametrize(
    "check", [unsafe_calls, entity_calls, open_listeners], ids=lambda check: check.__name__
)
def test_no_file_runs_a_shell_or_hidden_code_follows_an_entity_or_listens_beyond_loopback(check):
    found = {module_of(file): check(file.read_text(encoding="utf-8")) for file in FILES}
    assert {module: calls for module, calls in found.items() if calls} == {}


def set_on_others(source: str, room: str) -> set[str]:
    """Return the attributes that a source sets on what it imports from another room."""
    nodes = nodes_of(source)
    froms = [n for n in nodes if isinstance(n, ast.ImportFrom) and n.module]
    others = [n for n in froms if layer_of(str(n.module)) not in {room, ""}]
    names = {alias.asname or alias.name for n in others for alias in n.names}
    set_here = [n for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)]
    return {ast.unparse(n) for n in set_here if ast.unparse(n.value) in names}


def test_what_a_room_has_is_whole_before_another_is_imported():
    added = "from merge_sumo.scenario.scenario import MergeScenario\nMergeScenario.measures = None"
    assert set_on_others(added, "metrics") == {"MergeScenario.measures"}
    assert set_on_others(added, "scenario") == set()
    found = {f: set_on_others(f.read_text("utf-8"), layer_of(module_of(f))) for f in FILES}
    assert {file: names for file, names in found.items() if names} == {}


LINES_OF_A_FILE = 700
LINES_OF_A_FUNCTION = 60  # without its docstring, which has a line for each argument


def test_no_file_and_no_function_is_longer_than_a_reader_can_hold():
    long = {}
    for file in FILES:
        source = file.read_text(encoding="utf-8")
        if (lines := len(source.splitlines())) > LINES_OF_A_FILE:
            long[module_of(file)] = lines
        for node in nodes_of(source):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                docstring = len((ast.get_docstring(node) or "").splitlines())
                lines = (node.end_lineno or 0) - node.lineno + 1 - docstring
                if lines > LINES_OF_A_FUNCTION:
                    long[f"{module_of(file)}.{node.name}"] = lines
    assert long == {}


def test_no_two_classes_have_one_name():
    files = defaultdict(list)
    for file in FILES:
        for node in nodes_of(file.read_text(encoding="utf-8")):
            if isinstance(node, ast.ClassDef):
                files[node.name].append(module_of(file))
    assert {name: known for name, known in files.items() if len(known) > 1} == {}


FLAG = re.compile(r"^[^-].*[ (`]--[a-z]")
"""A flag behind a word: what begins with one is an argument of a program."""
A_COMMAND = re.compile(r"(?:merge-sumo|pip|netconvert) ")


def flags_in_messages(source: str) -> list[str]:
    """Return the texts of a source that name a flag, but for those that give a command to copy."""
    prose = {node.value for node in nodes_of(source) if isinstance(node, ast.Expr)}
    parts = {
        part for node in nodes_of(source) if isinstance(node, ast.JoinedStr) for part in node.values
    }
    texts = [
        ast.unparse(node)
        for node in nodes_of(source)
        if isinstance(node, ast.JoinedStr)
        or (isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in parts)
        if node not in prose
    ]
    return [
        text for text in texts if FLAG.search(text.lstrip("f'\" ")) and not A_COMMAND.search(text)
    ]


def test_no_message_below_the_commands_names_a_flag():
    """A message names a field in backticks; a command turns it into its flag."""
    others = [
        file
        for file in FILES
        if file.relative_to(PACKAGE).parts[0] not in ("commands", "sumo") and file.parent != PACKAGE
    ]
    found = {
        module_of(file): flags_in_messages(file.read_text(encoding="utf-8")) for file in others
    }
    assert {module: texts for module, texts in found.items() if texts} == {}


def test_what_removes_files_is_in_one_place():
    removing = {module_of(file) for file in FILES if removals(file.read_text(encoding="utf-8"))}
    assert removing == MAY_REMOVE


class TestTheChecksThemselves:
    @pytest.mark.parametrize(
        ("check", "source"),
        [
            (removals, "shutil.rmtree(p)"),
            (removals, "new.rename(old)"),
            (imports_a_variable, "import_module(name)"),
            (unsafe_calls, "subprocess.run('ls', shell=True)"),
            (unsafe_calls, "os.system('ls')"),
            (unsafe_calls, "np.load(path)"),
            (unsafe_calls, "numpy.load(path, allow_pickle=flag)"),
            (entity_calls, "etree.XMLParser(resolve_entities=True)"),
            (entity_calls, "etree.fromstring(text)"),
            (entity_calls, "etree.parse(path)"),
            (open_listeners, "s.bind(('0.0.0.0', 0))"),
            (open_listeners, "s.bind((host, 0))"),
            (open_listeners, "HOST = '0.0.0.0'\ns.bind((HOST, 0))"),
            (open_listeners, "http.server.HTTPServer(('', 1), Handler)"),
        ],
    )
    def test_see_what_no_file_may_do(self, check, source):
        assert check(source)

    @pytest.mark.parametrize(
        ("check", "source"),
        [
            (imports_a_variable, "import_module('libsumo')"),
            (unsafe_calls, "np.load(p, allow_pickle=False)\nrun(['ls'], shell=False)"),
            (open_listeners, "s.bind(('127.0.0.1', 0))"),
            (open_listeners, "HOST: Final = '127.0.0.1'\ns.bind((HOST, port))"),
        ],
    )
    def test_let_the_rest_pass(self, check, source):
        assert not check(source)

    def test_see_a_circle(self):
        graph = {"a": {"b"}, "b": {"c", "d"}, "c": set(), "d": {"b"}}
        assert circle_in(graph) == ["b", "d"]
        assert circle_in({"a": {"b"}, "b": {"c"}, "c": set()}) == []


CLOCKS = frozenset({"monotonic", "perf_counter", "time", "monotonic_ns", "perf_counter_ns"})


def test_no_test_compares_a_clock():
    """A machine may be busy: CPU time is measured, and work is counted (`processes.py`)."""
    comparing = [
        f"{path.name}, line {node.lineno}"
        for path in sorted(Path(__file__).parent.rglob("*.py"))
        for node in nodes_of(path.read_text(encoding="utf-8"))
        if isinstance(node, ast.Compare)
        and CLOCKS & {called(call) for call in ast.walk(node) if isinstance(call, ast.Call)}
    ]
    assert comparing == []

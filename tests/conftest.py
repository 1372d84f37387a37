"""Fixtures for all tests: real SUMO worlds and finished campaigns."""

# mypy: no-strict-optional

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest
from support.calling import Said
from support.campaigning import campaign_settings, run_campaign
from support.foreign_nets import foreign_road
from threadpoolctl import threadpool_limits

from merge_sumo import cli
from merge_sumo.analysis import share
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.road.road import Road
from merge_sumo.simulation import evaluate


def pytest_configure() -> None:
    """Let linear algebra have one thread in each process: tests run on all cores."""
    for library in ("OMP", "OPENBLAS", "MKL"):  # of those that are loaded later, and of children
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    threadpool_limits(1)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int | None:
    """Run in this process where output is not captured, or only files are named."""
    alone = config.option.capture == "no" or all(".py" in name for name in config.args)
    return 0 if alone else None


def require(available: bool, reason: str) -> None:
    """Skip with a reason where something is absent; fail instead when CI=true."""
    if available:
        return
    if os.environ.get("CI") == "true":
        pytest.fail(f"CI must have it: {reason}")
    pytest.skip(reason)


def some(values: Iterable[Any], *kept: object) -> list[Any]:
    """Return parameters of a test: the default run takes the kept ones, `-m long` the others."""
    return [v if v in kept else pytest.param(v, marks=pytest.mark.long) for v in values]


@pytest.fixture(autouse=True, scope="session")
def few_uniform_starts() -> Iterator[None]:
    """Let campaigns of this process measure the share that fails by 200 starts, not by 2,000."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(share, "CASES", share.CASES_IN_SUMO)
        yield


@pytest.fixture(autouse=True, scope="module")
def no_simulation_left() -> Iterator[None]:
    """Close what `simulate` keeps open in this process: libsumo holds one simulation at a time."""
    yield
    evaluate.close_simulator()


@pytest.fixture(scope="session")
def run(tmp_path_factory) -> RecordedCampaign:
    """Return a small finished campaign with failures: design1 against level 0."""
    settings = campaign_settings(vut="design1", cases=60, batch=20, seed=1)
    return run_campaign(settings, tmp_path_factory.mktemp("campaign") / "run")


@pytest.fixture(scope="session")
def built_road(tmp_path_factory):
    """Return a function that builds a foreign net once and gives its road."""
    built = {}

    def get(name: str) -> Road:
        if name not in built:
            built[name] = foreign_road(name, tmp_path_factory.mktemp("net"))
        return built[name]

    return get


@pytest.fixture(scope="session")
def display() -> Iterator[str]:
    """Start an X server without a screen on a display that is free, and return its name."""
    program = shutil.which("Xvfb")
    require(program is not None, "Xvfb is not on the PATH")
    end, start = os.pipe()
    server = subprocess.Popen(
        [program, "-displayfd", str(start), "-screen", "0", "1280x800x24", "-nolisten", "tcp"],
        pass_fds=[start],
        stderr=subprocess.DEVNULL,
    )
    try:
        os.close(start)
        with os.fdopen(end) as ready:
            number = ready.readline().strip()
        assert number, "Xvfb did not start"
        yield f":{number}"
    finally:
        server.terminate()
        server.wait()


@pytest.fixture
def command_line(monkeypatch, capfd):
    """Return a function that runs the command line in this process.

    It returns the exit code, the output and the errors; SUMO's own output counts too.
    """

    def main(*arguments: object) -> Said:
        monkeypatch.setattr(sys, "argv", ["merge-sumo", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main()
        return Said(int(end.value.code or 0), *capfd.readouterr())

    return main


@pytest.fixture
def call(monkeypatch, tmp_path, command_line) -> Callable[..., Said]:
    """Return what runs the command line, from a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return command_line


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item):
    """Continue to measure coverage after a test in which a signal has ended the tracer."""
    tracer = sys.gettrace()
    yield
    if tracer is not None and sys.gettrace() is None:
        item.warn(pytest.PytestWarning("the tracer of coverage had ended and was set again"))
        sys.settrace(tracer)


@pytest.fixture
def write_vut(tmp_path):
    """Return a function that writes the source of a controller, and returns its spec."""

    def write(source: str, name: str = "Vut", file: str = "my_vut.py") -> str:
        (tmp_path / file).write_text(source, encoding="utf-8")
        return f"{tmp_path / file}:{name}"

    return write

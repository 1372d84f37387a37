"""sumo-gui in the place of libsumo: a case is shown while it is run.

sumo-gui takes the same commands as libsumo, with the same numbers: a world that is given a `Window`
as its binding moves the same to the last bit. It runs in a process of its own (`child.py`), which
is killed in the end: it opens no port, a process can have one window in its life, and libsumo does
not come back from closing it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import partial
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.scenario.colours import rgb
from merge_sumo.scenario.scenario import DT_S, POV, VEHICLES, VUT
from merge_sumo.sumo.binding import SPEED_MODE_COMMANDED, load_libsumo, scratch_folder
from merge_sumo.sumo.child import Channel, ChildDiedError, SumoChild, channel_of
from merge_sumo.sumo.replay import check_display
from merge_sumo.sumo.replay_folder import WINDOW, beside, view_settings
from merge_sumo.system.interrupt import stopping_in_order

LEAST_M: Final = 120.0
"""Width of the road that the window shows at least, with the VUT in the middle."""
SEEN: Final = 1.15
"""Where another car is, as a multiple of its distance, that the window shows, too."""
LARGER: Final = "2"
"""How much larger the cars are drawn than they are."""
BEFORE_S: Final = 1.5
"""For which the start is shown, so that a person finds the cars."""
LOOK_S: Final = 0.5
"""Between two looks whether the window is still open."""
VIEW: Final = "View #0"
LABEL: Final = "label"
OPENS_S: Final = 60.0
"""Time that the window has to open."""


ANSWERS_S: Final = 60.0
"""A window that takes longer for a call hangs."""
ROOM: Final = 1.3
"""The view is wider than what it has to show by this, and moved again where that is too little."""


class Window(AbstractContextManager["Window"]):
    """A sumo-gui that a `World` takes for libsumo; steps take as long as what they show.

    Raises `UserError` when there is no display, or when the window is closed before its time.
    """

    def __init__(self) -> None:
        check_display()
        self.TraCIException: type[Exception] = RefusedByWindowError
        self.FatalTraCIError: type[Exception] = _NeverError
        self._opened = ExitStack()
        self._due_s: float | None = None
        self._shown = 0
        self.first = 0  # rows before this one pass without delay
        self._half_m = 0.0
        """Half of the width that the view shows; 0 before it follows the VUT."""

    def start(self, command: list[str]) -> None:
        """Open sumo-gui on what libsumo would be started with."""
        with ExitStack() as opened:
            opened.enter_context(stopping_in_order())
            stage = opened.enter_context(scratch_folder())
            view = stage / "view.settings.xml"
            settings = view_settings(LARGER, ("100", "0", "0"), label=LABEL)
            view.write_bytes(etree.tostring(settings))
            look = ("--gui-settings-file", str(view), "--window-size", ",".join(map(str, WINDOW)))
            # The window reads the net behind our back, when the world has removed its files.
            files = [_kept(argument, stage) for argument in command[1:]]
            options = ["sumo-gui", *files, *look, "--start", "--delay", "0"]
            self._child = SumoChild(f"{__name__}:{main.__name__}", stage, {})
            opened.callback(self._child.kill)
            try:
                self._call("start", options, patience_s=OPENS_S)
            except (UserError, TimeoutError) as error:
                why = self._child.said() or "it does not answer"
                raise UserError(f"sumo-gui did not open: {why}") from error
            self._opened = opened.pop_all()
        self.vehicle = _Domain("vehicle", self._call)
        self.route = _Domain("route", self._call)
        self._gui = _Domain("gui", self._call)
        self.simulation = self

    def _call(
        self, function: str, *arguments: Any, patience_s: float = ANSWERS_S, **options: Any
    ) -> Any:
        """Return what the window's libsumo answers; `UserError` when it is closed."""
        message = {"call": function, "arguments": arguments, "options": options}
        try:
            answer = self._child.ask(message, patience_s)
        except ChildDiedError as error:
            raise _closed() from error
        except TimeoutError as error:
            raise UserError("sumo-gui does not answer any more: run the case again") from error
        if "refused" in answer:
            raise RefusedByWindowError(answer["refused"])
        if "closed" in answer:
            raise _closed()
        return answer["value"]

    def step(self) -> None:
        """Make a step when its time has come; real time, from the second one on."""
        if self._shown > self.first:
            self._look()
            now_s = monotonic()
            first = self._due_s is None
            self._due_s = now_s + BEFORE_S if first else self._due_s + DT_S  # type: ignore[operator]
            sleep(max(self._due_s - now_s, 0.0))
        self._call("simulation.step")
        self._shown += 1
        if self._shown == 1:
            self._colour()

    def wait(self) -> None:
        """Hold the cars where they are until the window is closed; only the clock runs on.

        Without steps sumo-gui would not hear that it is to close.
        """
        with suppress(UserError):
            self._look()
            for name in self.vehicle.getIDList():
                self.vehicle.setSpeedMode(name, SPEED_MODE_COMMANDED)
                self.vehicle.setPreviousSpeed(name, 0.0, 0.0)
                self.vehicle.setSpeed(name, 0.0)
            while True:
                self._call("simulation.step")
                sleep(LOOK_S)

    def close(self) -> None:
        """Close the window."""
        self._opened.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _colour(self) -> None:
        """Give the cars the colours that they have in a replay."""
        vehicle = self.vehicle
        for name in vehicle.getIDList():
            vehicle.setColor(name, (*rgb(_car(name)), 255))

    def _look(self) -> None:
        """Write the speeds beside the cars, and let the view follow the VUT.

        The VUT is in the middle, and the other cars are in the picture.
        """
        vehicle, places, vut = self.vehicle, {}, ""
        for name in vehicle.getIDList():
            places[_car(name)] = vehicle.getPosition(name)
            vut = name if _car(name) == VEHICLES[VUT] else vut
        x, y = places[VEHICLES[VUT]]
        for name in vehicle.getIDList():
            car = _car(name)
            text = f"{car.upper()} {vehicle.getSpeed(name):.1f} m/s"
            ahead = x >= places[VEHICLES[POV]][0] if car == VEHICLES[VUT] else places[car][0] > x
            vehicle.setParameter(name, LABEL, beside(text, ahead=ahead))
        wide, high = WINDOW
        half_m = max(
            LEAST_M / 2.0,
            *(SEEN * max(abs(to[0] - x), abs(to[1] - y) * wide / high) for to in places.values()),
        )
        # The window draws in another thread, and moving its view from ours may hang it: that is
        # done as seldom as can be.
        if not self._half_m / ROOM**2 < half_m <= self._half_m:
            self._half_m = half_m = ROOM * half_m
            half_high_m = half_m * high / wide
            box = x - half_m, y - half_high_m, x + half_m, y + half_high_m
            self._gui.setBoundary(VIEW, *box)
            self._gui.trackVehicle(VIEW, vut)


class _NeverError(Exception):
    """What a window raises in the place of libsumo's fatal error: it has another for that."""


class RefusedByWindowError(Exception):
    """What a window raises in the place of libsumo's exception."""


def _closed() -> UserError:
    return UserError("the window was closed before the case had ended")


class _Domain:
    """A domain of libsumo, in the window's process."""

    def __init__(self, name: str, call: Callable[..., Any]) -> None:
        self._name, self._call = name, call

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return partial(self._call, f"{self._name}.{name}")


def main(settings: Mapping[str, Any]) -> None:
    """Do in the window's process what the other one asks for, until it ends this one."""
    channel = channel_of(settings)
    libsumo = load_libsumo()
    with suppress(EOFError, OSError):
        _serve(channel, libsumo)


def _serve(channel: Channel, libsumo: Any) -> None:
    while True:
        message = channel.receive()
        called = libsumo
        for name in message["call"].split("."):
            called = getattr(called, name)
        try:
            value = called(*message["arguments"], **message["options"])
        except libsumo.TraCIException as error:
            channel.send({"refused": str(error)})
        except libsumo.FatalTraCIError:
            channel.send({"closed": True})
        else:
            channel.send({"value": None if message["call"] == "start" else value})


def _car(name: str) -> str:
    """Return the name of a vehicle without its corridor."""
    return name.partition(".")[0]


def _kept(argument: str, folder: Path) -> str:
    """Return an argument, with a copy in a folder in the place of a file."""
    file = Path(argument)
    return str(shutil.copy(file, folder / file.name)) if file.is_file() else argument

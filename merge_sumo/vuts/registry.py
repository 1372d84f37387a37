"""The kinds of VUT, and the way from a spec, as after `--vut`, to a driver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Final

from merge_sumo.drivers.base import Design, Driver
from merge_sumo.drivers.gap_acceptance import ROUNDABOUT, GapAcceptanceVut
from merge_sumo.drivers.gap_choice import HEADWAY, GapChoiceVut
from merge_sumo.drivers.level0 import Level0Vut
from merge_sumo.drivers.policies import load_driver
from merge_sumo.drivers.reference import REFERENCES
from merge_sumo.drivers.rule_based import DESIGNS, RuleBasedVut
from merge_sumo.errors import UserError
from merge_sumo.sumo.world import World
from merge_sumo.system.hashing import Files, hashed
from merge_sumo.system.printable import quoted
from merge_sumo.system.registry import Registry
from merge_sumo.system.suggestions import meant
from merge_sumo.system.trust import check_code
from merge_sumo.system.workers import workers_or_cores
from merge_sumo.vuts.base import Vut, VutOptions, numbers_of, split_options
from merge_sumo.vuts.fmu import fmu_vut
from merge_sumo.vuts.host.hosted import SUPPORTED, hosted_vut
from merge_sumo.vuts.in_memory import HERE, here_vut, keep, object_of
from merge_sumo.vuts.onnx import onnx_vut
from merge_sumo.vuts.parameters import Range, spec_with, unknown_parameter
from merge_sumo.vuts.python import installed_vut, installed_vuts, python_vut
from merge_sumo.vuts.sumo_model import sumo_vut
from merge_sumo.vuts.traci.vut import is_port, traci_vut


@dataclass(frozen=True, kw_only=True, slots=True)
class VutKind:
    """A kind of VUT: all that the package asks of it."""

    form: str = ""  # what a person writes for it; "" for a kind that no list shows
    what: str = ""  # what it is, in a phrase
    example: str = ""  # an option `--vut` that names one
    prepare: Callable[[str, VutOptions], Vut]
    """Makes the VUT of an argument, which is what stands behind the colon of a kind with a name
    of its own, else the whole spec; raises `UserError`."""
    hosted: bool = False
    """Whether it runs a user's code in this process, unless that is hosted in one of its own."""
    own_code: bool = True
    """Whether to test it is to run code that is neither of this package nor of SUMO."""
    waits: Callable[[str], bool] = lambda _: False
    """Returns whether the controller of an argument is a program that a person starts."""
    file_of: Callable[[str], str] = lambda _: ""
    """Returns the file that an argument names; "" for none."""
    no_pov: str = ""  # why it cannot drive a POV; "" where it can
    no_parameters: str = ""
    """Why a spec cannot set the parameters of its controller, in a clause; "" where it can."""


def _python_file(spec: str) -> str:
    source = _before_options(spec).rpartition(":")[0]
    return source if source.endswith(".py") else ""


def _before_options(argument: str) -> str:
    return argument.partition("?")[0]


@dataclass(frozen=True, slots=True)
class BuiltInVut:
    """A VUT that the package brings.

    Attributes:
        make: makes its driver for a number of corridors, by its design where it has one, by a
            folder of networks where it is learned.
        design: the parameters that a spec may set, with their values where it does not.
        network: name of the network by which a learned VUT acts.
        ramp_only: whether it cannot drive a POV.
    """

    make: Callable[..., Driver]
    design: Design | None = None
    network: str = ""
    ramp_only: bool = False


BUILT_IN_VUTS: Final[dict[str, BuiltInVut]] = {
    "level0": BuiltInVut(Level0Vut, ramp_only=True),
    "level1": BuiltInVut(partial(load_driver, "vut1"), network="vut1", ramp_only=True),
    "level2": BuiltInVut(partial(load_driver, "vut2"), network="vut2", ramp_only=True),
    **{name: BuiltInVut(RuleBasedVut, design) for name, design in DESIGNS.items()},
    "gap": BuiltInVut(GapChoiceVut, HEADWAY, ramp_only=True),
    "roundabout": BuiltInVut(GapAcceptanceVut, ROUNDABOUT),
    **{name: BuiltInVut(driver) for name, driver in REFERENCES.items()},
}
"""The VUTs that the package brings, by name."""


def is_built_in(spec: str) -> bool:
    """Return whether a spec names a VUT that the package brings, with parameters or without."""
    return _before_options(spec) in BUILT_IN_VUTS


def _built_in_vut(spec: str, options: VutOptions) -> Vut:
    name, given = split_options(spec, spec)
    built_in = BUILT_IN_VUTS[name]
    known = {} if built_in.design is None else asdict(built_in.design)
    chosen = {parameter: float(value) for parameter, value in numbers_of(given, spec).items()}
    for parameter in chosen:
        if parameter not in known:
            raise unknown_parameter(spec, parameter, known)
    arguments: tuple[Any, ...] = (options.policies,) if built_in.network else ()
    if built_in.design is not None:
        try:
            arguments = (replace(built_in.design, **chosen),)
        except UserError as error:
            raise UserError(f"--vut {spec}: {error}") from error

    def make(corridors: int, _world: World | None) -> Driver:
        return built_in.make(corridors, *arguments)

    return Vut(make=make, by_arrays=True, parameters=known | chosen)


PYTHON: Final = VutKind(
    form="MODULE:NAME[?PARAMETER=VALUE&...] or FILE.py:NAME",
    what="a class with act(seen), a function of seen, or a batched class",
    example="--vut my_vut.py:MyVut",
    prepare=python_vut,
    hosted=True,
    file_of=_python_file,
)
INSTALLED: Final = replace(PYTHON, prepare=installed_vut)
BUILT_IN: Final = VutKind(prepare=_built_in_vut, own_code=False)
RAMP_ONLY: Final = replace(
    BUILT_IN,
    no_pov="that is a VUT for the ramp; --level chooses the POVs of levels 0 to 2",
)
KINDS: Final[Registry[VutKind]] = Registry(
    "merge_sumo.vut_kinds",
    "kind of VUT",
    {
        "traci": VutKind(
            form="traci:COMMAND or traci[:PORT]",
            what="a program in any language that drives `vut` by TraCI; started by you where no "
            "command is given",
            example='--vut "traci:python my_controller.py {port}"',
            prepare=traci_vut,
            waits=is_port,
            no_parameters="a TraCI client is a program with parameters of its own",
            no_pov=(
                "a TraCI client drives the vehicle `vut` and no other; bring the POV as Python, an "
                "FMU, a network or sumo:MODEL"
            ),
        ),
        "sumo": VutKind(
            form="sumo:MODEL[?OPTION=VALUE&...]",
            what="SUMO's own driver: Krauss, IDM, EIDM, ACC or CACC with SUMO's junction logic",
            example='--vut "sumo:IDM?tau=1.2"',
            prepare=sumo_vut,
            own_code=False,
        ),
        "onnx": VutKind(
            form="onnx:FILE[?decision_period_s=SECONDS]",
            what="a network from the state to an acceleration, or to values of the 7 actions",
            example="--vut onnx:policy.onnx",
            no_parameters="the parameters of a network are its weights",
            prepare=onnx_vut,
            hosted=True,
            file_of=_before_options,
        ),
        "fmu": VutKind(
            form="fmu:FILE[?VARIABLE=NAME&...]",
            what="an FMI 2.0 or 3.0 co-simulation unit, with its names of the variables",
            example='--vut "fmu:controller.fmu?v_vut_mps=Speed&acceleration_mps2=Cmd"',
            no_parameters="the options of an FMU are the names of its variables",
            prepare=fmu_vut,
            hosted=True,
            file_of=_before_options,
        ),
        HERE: VutKind(prepare=here_vut),
    },
    accepts=lambda item: isinstance(item, VutKind),
    contract="a merge_sumo.vuts.registry.VutKind",
)
"""The kinds that have a name of their own before the colon."""


@dataclass(frozen=True)
class VutFactory:
    """Makes the driver that `spec` names; plain values, which travel to other processes.

    `files` are those of the user's that the VUT is made of, with their hashes, as far as they are
    known before it drives; they are looked up unless they are given. Raises `UserError` for a spec
    that names no VUT, or one that cannot be loaded.
    """

    spec: str
    options: VutOptions = field(default_factory=VutOptions)
    files: Files | None = field(default=None, hash=False)

    def __post_init__(self) -> None:
        if self.files is None:
            object.__setattr__(self, "files", hashed(self.vut.files))

    @cached_property
    def vut(self) -> Vut:
        """What the spec names."""
        return find_vut(self.spec, self.options)

    def with_log(self, log: Path) -> VutFactory:
        """Return what makes the same VUT, with what it prints added to a file."""
        return VutFactory(self.spec, replace(self.options, log=log), self.files)

    def workers(self, requested: int | None) -> int:
        """Return in how many processes it is tested: the requested ones, or one a core for None.

        Raises `UserError` when more are requested than it can serve, or less than one.
        """
        count, most = workers_or_cores(requested), self.vut.max_workers
        if most is None or count <= most:
            return count
        if requested is None:
            return most
        raise UserError(f"--workers is {requested}: {self.spec} serves at most {most} at a time")

    def __call__(self, corridors: int, world: World | None = None) -> Driver:
        """Return a driver for corridors 0 to `corridors` - 1 of a world.

        Raises `UserError` where the files of the VUT have changed since this was made.
        """
        then, now = self.files or {}, hashed(self.vut.files)
        if set(then.values()) != set(now.values()):
            raise UserError(
                f"the files of the VUT {self.spec} are not those with which this began: let them "
                "be while it runs, and let all workers have the same"
            )
        return self.vut.make(corridors, world)

    def __reduce__(self) -> tuple[Callable[..., VutFactory], tuple[Any, ...]]:
        """Travel as plain values, with an object of this process; look the VUT up on arrival."""
        return (_arrived, (self.spec, self.options, self.files, object_of(self.spec)))


def _arrived(spec: str, options: VutOptions, files: Files | None, vut: Any) -> VutFactory:
    if vut is not None:
        keep(spec, vut)
    return VutFactory(spec, options, files)


def kind_of(spec: str) -> VutKind:
    """Return the kind of VUT that a spec names; an unknown name counts as installed."""
    prefix, colon, _ = spec.partition(":")
    if prefix in KINDS:
        return KINDS[prefix]
    built_in = BUILT_IN_VUTS.get(_before_options(spec))
    if built_in is not None:
        return RAMP_ONLY if built_in.ramp_only else BUILT_IN
    return PYTHON if colon else INSTALLED


def runs_code(spec: str) -> bool:
    """Return whether to test a VUT is to run code that is not of this package or of SUMO."""
    return kind_of(spec).own_code and not waits_for_client(spec)


def names_code(spec: str) -> bool:
    """Return whether who writes a spec says which code of a user's is run.

    An object of this process was put there by who runs it.
    """
    return runs_code(spec) and object_of(spec) is None


def waits_for_client(spec: str) -> bool:
    """Return whether a person starts the VUT's program, which then cannot be begun anew."""
    return kind_of(spec).waits(_argument(spec))


def file_named(spec: str) -> str:
    """Return the file that a spec names; "" for none."""
    return kind_of(spec).file_of(_argument(spec))


def parameters_of(factory: VutFactory) -> dict[str, float]:
    """Return the parameters of a VUT that a spec may set, with their present values.

    A Python controller is made to tell its attributes. Of SUMO's drivers only those are known that
    the spec sets. Raises `UserError` for a kind without parameters.
    """
    kind = kind_of(factory.spec)
    if kind.no_parameters:
        raise UserError(f"{factory.spec} has no parameters to change: {kind.no_parameters}")
    if factory.vut.parameters is not None:
        return dict(factory.vut.parameters)
    with closing(factory(1)) as driver:
        return dict(driver.parameters())


def values_of(factory: VutFactory, ranges: Sequence[Range]) -> dict[str, float]:
    """Return the present values of the parameters of some ranges, by name.

    Raises `UserError` where one is unknown, named twice, or out of its range.
    """
    known = parameters_of(factory) if ranges else {}
    names = [each.name for each in ranges]
    for each in ranges:
        if names.count(each.name) > 1:
            raise UserError(f"--param {each.name} is given twice: give each parameter once")
        if each.name not in known and factory.vut.vut_type is not None:
            raise UserError(
                f"--param {each.name}: its value today is not known; name it, as in "
                f"--vut {quoted(spec_with(factory.spec, {each.name: each.low}))}"
            )
        if each.name not in known:
            hint = meant(each.name, known)
            choice = f"{hint}choose from {', '.join(sorted(known))}" if known else "it has none"
            raise UserError(f"--param {each.name}: {factory.spec} has no such parameter: {choice}")
        if not each.low <= known[each.name] <= each.high:
            raise UserError(
                f"--param {each.name}={each.low:g}..{each.high:g}: it is {known[each.name]:g} "
                "today, which is not in that range: give a range around it"
            )
    return {name: float(known[name]) for name in names}


def _argument(spec: str) -> str:
    prefix, _, argument = spec.partition(":")
    return argument if prefix in KINDS else spec


def find_vut(spec: str, options: VutOptions) -> Vut:
    """Return the VUT that a spec names, hosted in a process of its own where its kind says so.

    Raises `UserError` for an unknown name, and for a VUT that cannot be loaded.
    """
    kind = kind_of(spec)
    if kind is INSTALLED and spec.partition("?")[0] not in installed_vuts():
        raise UserError(_why_unknown(spec))
    if file := file_named(spec):
        check_code(Path(file))
    if kind.hosted and not options.in_process and SUPPORTED:
        # Facts of a Python controller do not depend on the values of its parameters.
        alike = _without_values(spec) if kind in (PYTHON, INSTALLED) else spec
        return hosted_vut(FINDER, spec, options, alike)
    return kind.prepare(_argument(spec), options)


def _without_values(spec: str) -> str:
    """Return a spec without the values of its parameters; `UserError` where one is no number."""
    named, given = split_options(spec, spec)
    return f"{named}?{'&'.join(sorted(numbers_of(given, spec)))}"


def _why_unknown(spec: str) -> str:
    if spec.endswith(".py"):
        return f"{spec} is a file: name a class or a function of it, {spec}:NAME"
    names = [*BUILT_IN_VUTS, *installed_vuts()]
    choice = f"{', '.join(names)}, or bring your own (`merge-sumo vuts` lists the kinds)"
    if not spec:
        return f"name the vehicle under test, as in --vut design2: {choice}"
    kinds = [name for name, kind in KINDS.items() if kind.form]
    return f"there is no VUT {spec!r}: {meant(spec, (*names, *kinds))}choose one of {choice}"


FINDER: Final = f"{__name__}:{find_vut.__name__}"
"""What finds a VUT in the process that hosts it."""

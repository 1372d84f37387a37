"""Registries of samplers, controllers and measures, of this package and by entry points.

They are `samplers.registry.SAMPLERS`, `controllers.kinds.KINDS` and `metrics.measures.MEASURES`.
A registry names its objects without importing them: names of this package stand in the registry,
names of others in the metadata of installed packages. An object is imported when it is asked for.
Only installed packages, which the user chose, are searched; the working folder is data.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Generic, TypeVar

from merge_sumo.errors import UserError
from merge_sumo.printable import meant

T = TypeVar("T")

OURS = "merge-sumo"


class Registry(Mapping[str, T], Generic[T]):
    """Objects of one kind by name: those of this package in their order, then installed ones.

    It is read like a dictionary. An unknown name, a name that stands twice, and an object that
    cannot be loaded or is of another kind raise `UserError`.

    Attributes:
        ours: objects of this package by name; a program may add its own.

    Example:
        SAMPLERS["gpr"]  # imports the class
    """

    def __init__(
        self,
        group: str,
        noun: str,
        ours: Mapping[str, str | T],
        *,
        accepts: Callable[[object], bool],
        contract: str,
    ) -> None:
        """Take the objects of this package.

        Args:
            group: group of entry points, as `merge_sumo.samplers`.
            noun: the kind of its objects, in the singular.
            ours: objects of this package by name, or `module:attribute` for an import when needed.
            accepts: returns whether a loaded object is of the kind.
            contract: required kind, for error messages, as "a subclass of Sampler".
        """
        self.group, self.noun = group, noun
        self._accepts, self._contract = accepts, contract
        self.ours: dict[str, EntryPoint | T] = {}
        for name, item in ours.items():
            self.ours[name] = EntryPoint(name, item, group) if isinstance(item, str) else item

    @property
    def packages(self) -> list[str]:
        """The installed packages that add to it, in the order of their names."""
        return sorted({package for found in entries_of(self.group).values() for package in found})

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self.ours, *entries_of(self.group))))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        return name in self.ours or name in entries_of(self.group)

    def __getitem__(self, name: str) -> T:
        bringers: dict[str, EntryPoint | T] = dict(entries_of(self.group).get(name, {}))
        if name in self.ours:
            bringers[OURS] = self.ours[name]
        if len(bringers) > 1:
            packages = " and ".join(sorted(bringers))
            raise UserError(
                f"{packages} each provide a {self.noun} {name!r}: keep one of them and uninstall "
                "the others"
            )
        if not bringers:
            raise UserError(
                f"unknown {self.noun} {name!r}: {meant(name, self)}choose one of {', '.join(self)}"
            )
        ((package, entry),) = bringers.items()
        if not isinstance(entry, EntryPoint):
            return entry
        try:
            item: T = entry.load()
        except (Exception, SystemExit) as error:
            raise UserError(
                f"the {self.noun} {name!r} of {package} cannot be loaded from {entry.value}: "
                f"{type(error).__name__}: {error}"
            ) from error
        if not self._accepts(item):
            raise UserError(f"the {self.noun} {name!r} of {package} is not {self._contract}")
        return item


def entries_of(group: str) -> dict[str, dict[str, EntryPoint]]:
    """Return the installed entry points of a group, by name and then by package.

    Nothing is imported. The working folder, which may be received, is not searched.

    Args:
        group: the group.
    """
    try:
        return _installed(group, tuple(sys.path), Path.cwd().resolve())
    except OSError:  # the working folder is gone
        return {}


@lru_cache(maxsize=64)
def _installed(
    group: str, _folders: tuple[str, ...], working_folder: Path
) -> dict[str, dict[str, EntryPoint]]:
    entries: dict[str, dict[str, EntryPoint]] = {}
    for entry in entry_points(group=group):
        package = entry.dist
        if package is not None and Path(str(package.locate_file(""))).resolve() != working_folder:
            # Where the backport of importlib.metadata is imported, as by Dask, entries are its own.
            plain = EntryPoint(entry.name, entry.value, group)
            entries.setdefault(entry.name, {})[package.name] = plain
    return entries

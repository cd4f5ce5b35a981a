"""Finds classes that fishd or other packages offer by name: controllers, drivers.

fishd's own stand in a table in the code. Those of other packages are entry points of a group, which
are read again once something was installed: a running fishd finds it without a restart.
"""

import importlib
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from functools import reduce
from importlib.machinery import PathFinder
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec
from msgspec import Struct

from fishd.core import text
from fishd.core.errors import FishdError
from fishd.core.foreign_code import contained
from fishd.core.schema import fields_of, nearest

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")


class Plugins(Generic[T]):
    """Subclasses of `base`, each of which names a struct of its parameters."""

    def __init__(
        self,
        kind: str,
        group: str,
        base: type[Any],
        struct: str,
        built_in: Mapping[str, str],
        unknown: type[FishdError],
        of: type[Struct] = Struct,
    ) -> None:
        """
        kind: what one is called in messages, such as `controller`
        group: entry points of other packages; a name of fishd's own is not replaced by theirs
        struct: name of the class attribute that is the struct, such as `Parameters`
        built_in: fishd's own, each with `module:class`
        unknown: raised where a name is unknown, or its package does not load
        of: what that struct is a subclass of
        """
        self.kind = kind
        self._group = group
        self._base = base
        self._struct = struct
        self._built_in = built_in
        self._unknown = unknown
        self._of = of
        self._found: dict[str, type[T]] = {}
        self._entries: dict[str, EntryPoint] = {}
        self._stamps: list[int] = []
        self.problems: dict[str, str] = {}
        """Why a plug-in, by its name, or all of a package, by the package's, is not available."""

    def names(self) -> list[str]:
        """All names, sorted, whether they load or not."""
        return sorted({*self._built_in, *self._offered()})

    def has(self, name: str) -> bool:
        """Is there one of that name, whether it loads or not?"""
        return name in self._built_in or name in self._offered()

    def package(self, name: str) -> str:
        """Where one comes from: `fishd`, or the name and version of another package."""
        found = None if name in self._built_in else self._offered()[name].dist
        return f"{found.name} {found.version}" if found else "fishd"

    def requirements(self, name: str) -> list[str]:
        """What the metadata of another package that offers one demands; none of fishd's own."""
        found = None if name in self._built_in else self._offered()[name].dist
        return (found.requires or []) if found else []

    def find(self, name: str) -> type[T]:
        """The class of that name; raises `unknown` if it does not exist, or does not load.

        `problems` keeps why one does not load, until it does.
        """
        if name not in self._found:
            try:
                self._found[name] = self._load(name)
            except self._unknown as error:
                if name in self._built_in or name in self._entries:
                    self.problems[name] = text.said(error)
                raise
            self.problems.pop(name, None)
        return self._found[name]

    def _load(self, name: str) -> type[T]:
        # Entry points only where they are needed: to find them takes tens of milliseconds.
        value = self._built_in.get(name) or getattr(self._offered().get(name), "value", "")
        if not value:
            hint = nearest(name, self.names())
            raise self._unknown(f"no {self.kind} is named '{text.quoted(name)}'; {hint}")
        where = f"{self.kind} '{name}' ({value} in {self.package(name)})"
        try:
            found = contained(_load_class, value.partition(" [")[0])
        except Exception as error:
            raise self._unknown(f"{where} does not load: {text.named(error)}") from error
        base = self._base
        if not (isinstance(found, type) and issubclass(found, base)):
            raise self._unknown(f"{where} is no subclass of {base.__module__}.{base.__qualname__}")
        if missing := sorted(getattr(found, "__abstractmethods__", ())):
            raise self._unknown(f"{where} does not define {', '.join(missing)}")
        struct: Any = getattr(found, self._struct, None)
        if not (isinstance(struct, type) and issubclass(struct, self._of)):
            wanted = f"{self._of.__module__}.{self._of.__qualname__}"
            wanted = "msgspec.Struct" if self._of is Struct else f"subclass of {wanted}"
            raise self._unknown(f"{where} has no {self._struct}, a {wanted}")
        try:
            contained(msgspec.json.encode, fields_of(struct))
        except Exception as error:
            raise self._unknown(
                f"{where} has {self._struct} that cannot be read: {text.named(error)}"
            ) from error
        return found

    def _offered(self) -> "dict[str, EntryPoint]":
        """The entry points of other packages, by name."""
        stamps = _stamps()
        if stamps != self._stamps:
            importlib.invalidate_caches()
            self._entries = self._read_entry_points()
            self._stamps = stamps
        return self._entries

    def _read_entry_points(self) -> "dict[str, EntryPoint]":
        if not _mentioned(self._group):
            return {}
        from importlib.metadata import distributions  # takes longer than to look

        entries: dict[str, EntryPoint] = {}
        for package in distributions():
            try:
                for entry in package.entry_points.select(group=self._group):
                    entries.setdefault(entry.name, entry)  # as for imports, the first counts
            except Exception as error:
                name = package.metadata["Name"] or "without a name"
                problem = f"the entry points of package {name} cannot be read: {text.named(error)}"
                self.problems[name] = problem
                import logging  # with as much as all else that is loaded here

                logging.getLogger(__name__).warning("%s", problem)
        return entries


def _load_class(name: str) -> Any:
    """Return what `module:class` names."""
    module, _, attributes = name.partition(":")
    return reduce(getattr, filter(None, attributes.split(".")), importlib.import_module(module))


def _mentioned(group: str) -> bool:
    """May an installed package offer entry points of this group? Only then all are looked at."""
    finders = [finder for finder in sys.meta_path if hasattr(finder, "find_distributions")]
    return finders != [PathFinder] or any(_mentions(path, group.encode()) for path in sys.path)


def _mentions(path: str, group: bytes) -> bool:
    """Does a package in this folder of sys.path? In an archive, one may.

    Without pathlib, which takes twice as long for hundreds of files.
    """
    try:
        names = os.listdir(path or ".")  # noqa: PTH208
    except NotADirectoryError:
        return True
    except OSError:
        return False
    for name in names:
        if name.lower().endswith((".dist-info", "egg-info")):
            with suppress(OSError), open(f"{path or '.'}/{name}/entry_points.txt", "rb") as file:  # noqa: PTH123
                if group in file.read():
                    return True
    return False


def _stamps() -> list[int]:
    """When each folder of sys.path changed last [ns]: a package that is installed changes one."""
    stamps = []
    for path in sys.path:
        try:
            stamps.append(os.stat(path or ".").st_mtime_ns)  # noqa: PTH116
        except OSError:
            stamps.append(0)
    return stamps

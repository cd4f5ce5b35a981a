"""Registry of classes that fishd or other packages offer by name: controllers, drivers.

fishd's classes are in a table in the code. Those of other packages are entry points of a group,
which are read once: a running fishd finds new ones after a restart.
"""

import importlib
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import msgspec
from msgspec import Struct

from fishd.core import text
from fishd.core.errors import FishdError
from fishd.core.foreign_code import call_foreign
from fishd.core.schema import fields_of, suggest

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")


class Plugins(Generic[T]):
    """Subclasses of `base`, each with a struct of its parameters as a class attribute."""

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
        kind: name of a plug-in in messages, such as `controller`
        group: group of entry points; they cannot replace a built-in plug-in of the same name
        struct: name of the class attribute that is the struct, such as `Parameters`
        built_in: names of fishd's plug-ins, each with `module:class`
        unknown: error for a name that is unknown, or whose package does not load
        of: base class of the struct
        """
        self.kind = kind
        self._group = group
        self._base = base
        self._struct = struct
        self._built_in = built_in
        self._unknown = unknown
        self._of = of
        self._found: dict[str, type[T]] = {}
        self.problems: dict[str, str] = {}
        """Reasons why plug-ins are unavailable, by name of the plug-in, or of the package if its
        entry points cannot be read."""

    def names(self) -> list[str]:
        """Return all names, sorted, whether they load or not."""
        return sorted({*self._built_in, *self._offered})

    def has(self, name: str) -> bool:
        """Return whether a plug-in of that name exists, whether it loads or not."""
        return name in self._built_in or name in self._offered

    def package(self, name: str) -> str:
        """Return the source of a plug-in: `fishd`, or the name and version of another package."""
        distribution = None if name in self._built_in else self._offered[name].dist
        return f"{distribution.name} {distribution.version}" if distribution else "fishd"

    def requirements(self, name: str) -> list[str]:
        """Return the requirements of the package that offers a plug-in; empty for fishd."""
        distribution = None if name in self._built_in else self._offered[name].dist
        return (distribution.requires or []) if distribution else []

    def find(self, name: str) -> type[T]:
        """Return the class of that name; raise `unknown` if it does not exist or does not load.

        `problems` has the reason why a plug-in does not load, until it does.
        """
        if name not in self._found:
            with self._noted(name):
                self._found[name] = self._load(name)
            self.problems.pop(name, None)
        return self._found[name]

    def try_import(self, name: str, timeout: float | None = None) -> None:
        """Import a plug-in of another package in a child process, for `find` after it.

        So the time that it takes is no part of that of `find`, except for the import itself.

        timeout: longest time of the import; None for that of `trial_import` [s]
        Raise `unknown` if the import ends or crashes its process, or does not end.
        """
        entry = None if name in self._built_in else self._offered.get(name)
        if entry is None or name in self._found:
            return
        module = entry.value.partition(":")[0].strip()
        if module in sys.modules:
            return
        from fishd.core.trial_import import find_danger  # imports subprocess

        with self._noted(name):
            try:
                danger = find_danger(module, timeout)
            except OSError as error:
                danger = text.describe_error(error)
            if danger:
                raise self._unknown(f"{self._where(name)} does not load: {danger}")

    @contextmanager
    def _noted(self, name: str) -> Iterator[None]:
        """Keep the reason in `problems` if a plug-in does not load."""
        try:
            yield
        except self._unknown as error:
            if name in self._built_in or name in self._offered:
                self.problems[name] = text.error_message(error)
            raise

    def _where(self, name: str) -> str:
        """Return the name and origin of a plug-in that exists, for messages."""
        value = self._built_in.get(name) or self._offered[name].value
        return f"{self.kind} '{name}' ({value} in {self.package(name)})"

    def _load(self, name: str) -> type[T]:
        # Entry points only if they are needed: finding them takes tens of milliseconds.
        value = self._built_in.get(name) or getattr(self._offered.get(name), "value", "")
        if not value:
            hint = suggest(name, self.names())
            raise self._unknown(f"no {self.kind} is named '{text.quoted(name)}'; {hint}")
        self.try_import(name)
        where = self._where(name)
        try:
            with _kept_process_state():
                plugin = call_foreign(_load_class, value.partition(" [")[0])
        except Exception as error:
            raise self._unknown(f"{where} does not load: {text.describe_error(error)}") from error
        base = self._base
        if not (isinstance(plugin, type) and issubclass(plugin, base)):
            raise self._unknown(
                f"{where} is not a subclass of {base.__module__}.{base.__qualname__}"
            )
        if missing := sorted(getattr(plugin, "__abstractmethods__", ())):
            raise self._unknown(f"{where} does not define {', '.join(missing)}")
        struct: Any = getattr(plugin, self._struct, None)
        if not (isinstance(struct, type) and issubclass(struct, self._of)):
            required = f"{self._of.__module__}.{self._of.__qualname__}"
            required = "msgspec.Struct" if self._of is Struct else f"subclass of {required}"
            raise self._unknown(f"{where} has no {self._struct}, a {required}")
        try:
            call_foreign(msgspec.json.encode, fields_of(struct))
        except Exception as error:
            raise self._unknown(
                f"{where} has {self._struct} that cannot be read: {text.describe_error(error)}"
            ) from error
        return plugin

    @cached_property
    def _offered(self) -> "dict[str, EntryPoint]":
        """Entry points of other packages, by name."""
        from importlib.metadata import distributions  # slow to import

        entries: dict[str, EntryPoint] = {}
        for package in distributions():
            try:
                for entry in package.entry_points.select(group=self._group):
                    entries.setdefault(entry.name, entry)  # the first one wins, as for imports
            except Exception as error:
                name = package.metadata["Name"] or "without a name"
                problem = (
                    f"the entry points of package {name} cannot be read: "
                    f"{text.describe_error(error)}"
                )
                self.problems[name] = problem
                import logging  # as slow to import as everything else here

                logging.getLogger(__name__).warning("%s", problem)
        return entries


@contextmanager
def _kept_process_state() -> Iterator[None]:
    """Restore the working directory, and in the main thread the handlers of signals, at the end.

    A package may change them while it is imported.
    """
    folder = os.open(".", os.O_PATH | os.O_DIRECTORY)  # this user may lack the right to read it
    in_main = threading.current_thread() is threading.main_thread()
    handlers = {n: signal.getsignal(n) for n in _SIGNALS} if in_main else {}
    try:
        yield
    finally:
        with suppress(PermissionError):  # this user may not enter the folder again
            os.fchdir(folder)
        os.close(folder)
        for number, handler in handlers.items():
            if handler is not None:  # None was not set by Python
                signal.signal(number, handler)


_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE)


def _load_class(name: str) -> Any:
    """Return the object that `module:class` names."""
    module, _, attributes = name.partition(":")
    return reduce(getattr, filter(None, attributes.split(".")), importlib.import_module(module))

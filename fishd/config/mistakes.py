"""Search for all mistakes of a configuration; `load` stops at the first.

Each key with a mistake is left out, until the rest is valid.
"""

import math
import os
import re
from collections.abc import Iterable
from typing import Any

from fishd.config import configuration
from fishd.config.configuration import Config
from fishd.config.drivers import CHOICES, SENSOR_SECTIONS
from fishd.core.errors import ConfigError
from fishd.core.overrides import apply_overrides
from fishd.core.schema import Problem, drop_empty_sections

MAX_MISTAKES = 100
"""Largest number of mistakes that are listed."""


def find(path: str | os.PathLike[str], overrides: Iterable[str] = ()) -> list[str]:
    """Return every mistake of a file with its overrides, each as `load` would report it.

    Empty if `load` accepts the file. A file from which no value can be read is one mistake.
    """
    mistakes: list[str] = []
    try:
        data, sources = configuration.read(path, mistakes)
    except ConfigError as error:
        return [str(error)]
    for override in overrides:
        try:
            sources |= apply_overrides(data, [override])
        except ConfigError as error:
            mistakes.append(str(error))
    problems = _MistakeSearch(data).problems
    mistakes += [problem.message_with_place(sources) for problem in problems]
    return sorted(mistakes, key=_line)[:MAX_MISTAKES]


class _MistakeSearch:
    """Configuration whose mistakes are collected and left out."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.problems: list[Problem] = []
        self._data = data
        if (config := self._convert()) is None:
            return
        # Another key of such a section may be valid with the right value of the wrong key.
        unsure = {problem.path[:1] for problem in self.problems}
        for check in configuration.CHECKS:
            while config is not None and (problem := _find_problem(check, config)):
                if problem.path[:1] not in unsure:
                    self.problems.append(problem)
                if not self._leave_out(problem.path):
                    break
                config = self._convert()

    def _convert(self) -> Config | None:
        """Return the rest of the configuration, or None if it is still not valid."""
        while len(self.problems) <= MAX_MISTAKES:
            try:
                return configuration.convert_sections(drop_empty_sections(self._data, Config))
            except Problem as problem:
                self.problems.append(problem)
                if not self._leave_out(problem.path):
                    break
        return None

    def _leave_out(self, path: tuple[str, ...]) -> bool:
        """Remove a key, or the nearest section around it; return whether there was one."""
        choice = CHOICES.get(path[0]) if path else None
        length = 2 if path[:1] == (SENSOR_SECTIONS,) else 1
        if choice and path[length:] == (choice.key,):
            path = path[:length]  # the other keys are those of another driver
        for length in range(len(path), 0, -1):
            section: Any = self._data
            for key in path[: length - 1]:
                section = section.get(key) if isinstance(section, dict) else None
            if isinstance(section, dict) and path[length - 1] in section:
                del section[path[length - 1]]
                return True
        return False


def _line(mistake: str) -> float:
    """Return the line of the file that a mistake is in; those of overrides come last."""
    match = re.match(r"\S*?:(\d+): ", mistake)
    return int(match[1]) if match else math.inf


def _find_problem(check: configuration.Check, config: Config) -> Problem | None:
    try:
        check(config)
    except Problem as problem:
        return problem
    return None

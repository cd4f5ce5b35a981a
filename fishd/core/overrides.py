"""Option `--set KEY=VALUE` of the command line, which overrides a key of a configuration."""

from collections.abc import Iterable
from typing import Any

from fishd.core import strict_yaml
from fishd.core.errors import ConfigError


def apply_overrides(data: dict[str, Any], overrides: Iterable[str]) -> dict[tuple[str, ...], str]:
    """Put each `KEY=VALUE` into the data; return the option that set each key, for messages.

    Raise `ConfigError`.
    """
    return {_apply(data, override): f"--set {override}" for override in overrides}


def _apply(data: dict[str, Any], override: str) -> tuple[str, ...]:
    """Put one KEY=VALUE into the data; return the key as a path."""
    dotted, equals, text = override.partition("=")
    keys = tuple(dotted.strip().split("."))
    if not equals or not all(keys):
        raise ConfigError(f"--set {override}: write KEY=VALUE, such as plant.omega0=10")
    section = data
    for key in keys[:-1]:
        if section.get(key) is None:
            section[key] = {}
        section = section[key]
        if not isinstance(section, dict):
            raise ConfigError(f"--set {override}: {key} is a single value, not a section")
    section[keys[-1]] = _value(text.strip(), dotted, override)
    return keys


def _value(text: str, dotted: str, override: str) -> Any:
    """Parse a value as YAML."""
    try:
        return strict_yaml.parse(text, name=dotted).data if text else ""
    except strict_yaml.YamlProblem as problem:
        raise ConfigError(f"--set {override}: {problem}") from None

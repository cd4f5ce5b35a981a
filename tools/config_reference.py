"""Writer of the tables of configuration keys, also of a camera, into docs/, from their schemas.

python tools/config_reference.py --write
python tools/config_reference.py --check     exits with 1 when they are out of date
"""

import inspect
import sys
from collections.abc import Iterator

import yaml
from msgspec import Struct

from common.report import table, write_reference
from fishd.camera.settings import CameraSettings
from fishd.config import Config
from fishd.config.drivers import CHOICES
from fishd.core.schema import Field, fields_of, format_permitted

PAGE = "reference/configuration.md"
HEAD = "key | permitted | default | description"
ANY = {
    "number": "any number",
    "integer": "any number",
    "text": "a text",
    "boolean": "`true`, `false`",
    "section": "keys and values",
    "list": "a list",
}
"""Texts for permitted values of types without bounds."""


def references() -> Iterator[tuple[str, str, str]]:
    """Yield documents, names of markers, and the tables between them."""
    structs: dict[str, Struct] = {"keys": Config(), "camera keys": CameraSettings()}
    for marker, struct in structs.items():
        yield PAGE, marker, "\n\n".join(_sections(struct))


def _sections(config: Struct) -> Iterator[str]:
    """Yield a table of the keys outside sections, then a heading and a table for each section."""
    nested = []
    plain = []
    for field in fields_of(type(config)):
        value = getattr(config, field.name)
        chosen = isinstance(config, Config) and field.name in CHOICES
        if chosen or isinstance(value, Struct):
            nested.append((field, value, chosen))
        else:
            plain.append(_row(field, value, ""))
    yield table(HEAD, plain)
    for field, value, chosen in nested:
        yield f"### `{field.name}`\n\n{field.description}"
        if chosen:
            yield from _choice_section(field.name)
        else:
            yield table(HEAD, _rows(value, f"{field.name}."))


def _rows(section: Struct, prefix: str) -> Iterator[list[str]]:
    """Yield a row for each key of a section and of the sections inside it."""
    for field in fields_of(type(section)):
        value = getattr(section, field.name)
        if isinstance(value, Struct):
            yield from _rows(value, f"{prefix}{field.name}.")
        else:
            yield _row(field, value, prefix)


def _choice_section(section: str) -> Iterator[str]:
    """Yield the keys of all drivers or plants, then those of each built-in one."""
    plugins, default, settings_of_default, key, page = CHOICES[section]
    prefix = f"{section}." if default else f"{section}.NAME."
    base = settings_of_default.__base__ if default else Struct
    common = (settings_of_default if base is Struct else base)(**{key: default or ""})
    mine = [name for name in plugins.names() if plugins.package(name) == "fishd"]
    choice, *rows = [
        _row(field, getattr(common, field.name), prefix) for field in fields_of(type(common))
    ]
    choice[1] = f"{', '.join(f'`{name}`' for name in mine)}, or [another](../how-to/{page})"
    yield table(HEAD, [choice, *rows])
    for name in mine:
        plugin_class = plugins.find(name)
        settings = plugin_class.Settings(**{key: name})
        own = [
            _row(field, getattr(settings, field.name), prefix)
            for field in fields_of(plugin_class.Settings)
            if not hasattr(common, field.name)
        ]
        if own:
            about = inspect.cleandoc(plugin_class.__doc__).partition("\n")[0]
            yield f"#### `{key}: {name}`\n\n{about}"
            yield table(HEAD, own)


def _row(field: Field, default: object, prefix: str) -> list[str]:
    permitted = format_permitted(field) or ANY[field.kind]
    if field.unit not in ("", "1"):
        permitted += f" {field.unit}"
    if field.kind == "integer":
        permitted += ", whole"
    permitted += "".join(f", or `{word}`" for word in field.words)
    if field.optional:
        permitted += ", or `null`"
    value = f"`{_to_yaml(default)}`"
    cells = (f"`{prefix}{field.name}`", permitted, value, field.description)
    return [cell.replace(" | ", ", ").replace("|", r"\|") for cell in cells]


def _to_yaml(value: object) -> str:
    """Return a value as YAML."""
    text: str = yaml.safe_dump(value, default_flow_style=True, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


if __name__ == "__main__":
    sys.exit(write_reference("config_reference", references()))

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

MARKER = "keys"
HEAD = "key | unit | permitted | default | description"
ANY = {
    "number": "any number",
    "integer": "any number",
    "text": "a text",
    "boolean": "`true`, `false`",
    "section": "keys and values",
    "list": "a list",
}
"""Texts for permitted values of types without bounds."""


def references() -> dict[str, str]:
    """Return the tables of the sections, by document."""
    whole: dict[str, Struct] = {
        "reference/configuration.md": Config(),
        "how-to/camera.md": CameraSettings(),
    }
    return {name: "\n\n".join(_sections(struct, "")) for name, struct in whole.items()}


def _sections(section: Struct, prefix: str) -> Iterator[str]:
    """Yield a heading and a table for a section, then for each section inside it."""
    plain, nested = [], []
    for field in fields_of(type(section)):
        value = getattr(section, field.name)
        if isinstance(value, Struct) or (isinstance(section, Config) and field.name in CHOICES):
            nested.append((field, value))
        else:
            plain.append(_row(field, value, prefix))
    if plain:
        yield table(HEAD, plain)
    for field, value in nested:
        name = prefix + field.name
        yield f"### `{name}`\n\n{field.description}"
        if field.name in CHOICES and isinstance(section, Config):
            yield from _choice_section(name)
        else:
            yield from _sections(value, name + ".")


def _choice_section(section: str) -> Iterator[str]:
    """Yield the keys of all drivers or plants, then those of each built-in one."""
    plugins, default, settings_of_default, key, page = CHOICES[section]
    base = settings_of_default.__base__ if default else Struct
    common = (settings_of_default if base is Struct else base)(**{key: default or ""})
    mine = [name for name in plugins.names() if plugins.package(name) == "fishd"]
    choice, *rows = [
        _row(field, getattr(common, field.name), f"{section}.") for field in fields_of(type(common))
    ]
    choice[2] = f"{', '.join(f'`{name}`' for name in mine)}, or [another](../how-to/{page})"
    yield table(HEAD, [choice, *rows])
    for name in mine:
        plugin_class = plugins.find(name)
        settings = plugin_class.Settings(**{key: name})
        own = [
            _row(field, getattr(settings, field.name), f"{section}.")
            for field in fields_of(plugin_class.Settings)
            if not hasattr(common, field.name)
        ]
        if own:
            about = inspect.cleandoc(plugin_class.__doc__).partition("\n")[0]
            yield f"#### `{key}: {name}`\n\n{about}"
            yield table(HEAD, own)


def _row(field: Field, default: object, prefix: str) -> list[str]:
    permitted = format_permitted(field) or ANY[field.kind]
    if field.kind == "integer":
        permitted += ", whole"
    permitted += "".join(f", or `{word}`" for word in field.words)
    if field.optional:
        permitted += ", or `null`"
    unit = "" if field.unit == "1" else field.unit
    value = f"`{_to_yaml(default)}`"
    cells = (f"`{prefix}{field.name}`", unit, permitted, value, field.description)
    return [cell.replace("|", r"\|") for cell in cells]


def _to_yaml(value: object) -> str:
    """Return a value as YAML."""
    text: str = yaml.safe_dump(value, default_flow_style=True)
    return text.removesuffix("\n").removesuffix("\n...")


if __name__ == "__main__":
    pages = references().items()
    sys.exit(write_reference("config_reference", [(page, MARKER, text) for page, text in pages]))

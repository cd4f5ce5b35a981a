"""Writes docs/configuration.md from the schema of the configuration.

`tools/config_reference.py` rewrites the file; with `--check` it writes nothing and exits 1 when the
file is out of date.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import click
import yaml
from msgspec import Struct

from fishd.config import Config
from fishd.schema import Field, fields_of

TARGET = Path(__file__).resolve().parent.parent / "docs" / "configuration.md"

PREAMBLE = """\
# Configuration

<!-- Written by tools/config_reference.py from the schema; change the schema or that program. -->

`fishd` needs no configuration: without one it runs a simulated fish at rest. A YAML file changes
what it names and leaves everything else at its default:

```yaml
tick: 0.05              # s
amplitude_limit: 0.42   # rad

start:
  controller: swing
  parameters:
    C: 0.6
```

```console
$ fishd --config fish.yaml
```

The file is read once, at start. Controllers and their parameters change while the fish swims, by
`fishctl set-controller` and `fishctl set-parameter`; everything else changes with a restart.

## One key from the command line

`--set KEY=VALUE` overrides one key, in dotted form. It can be repeated, and it wins over the file.
`fishd`, `fishctl simulate`, `fishctl config check` and `fishctl config show` take it:

```console
$ fishd --config fish.yaml --set plant.omega0=10 --set simulation.noise=1e-3
$ fishctl simulate swing --set amplitude_limit=0.3
$ fishd --set start.controller=square --set start.parameters.frequency=1.7
```

The value is read as a plain number where it is one, so `1e-3` and `.05` are numbers here. Anything
else is read as YAML: `true`, `null`, `{C: 0.7}`, `"a text"`.

## The file of this machine

`fishctl doctor` and `fishctl release` read the file that `--config` names, else the one that the
variable `FISHD_CONFIG` names, else `/etc/fishd/fishd.yaml` where there is one:
[installing.md](installing.md#which-file-fishctl-goes-by).

## Check a file before it is used

```console
$ fishctl config check fish.yaml
fish.yaml: good
$ fishctl config show fish.yaml      # every key with its value, defaults included, as YAML
$ fishctl config show --json         # the defaults alone, as JSON
$ fishctl config show --running      # what the fishd that runs was started with
$ fishctl config schema              # JSON Schema, for editors
```

What `config show` prints is itself a complete configuration file.

A wrong configuration never starts a fish. `fishd` and `fishctl config` print one line on standard
error and exit with status 78; `fishd` exits so before it opens anything. The line names the file,
the line, the key and what is permitted:

```text
fishd: fish.yaml:2: plant.omega: unknown key; did you mean 'omega0'?
fishd: fish.yaml:1: tick: 1 is not valid: a number in [0.002, 0.2] s is needed
fishd: --set plant.xi=99: plant.xi: 99 is not valid: a number in [0, 20] is needed
fishd: fish.yaml:4: start.parameters.C: swing: C: 3 is not valid: a number in [0, 1] is needed
```

The parameters under `start` are checked against the controller that is to take them, and against
`amplitude_limit`. Unknown keys, values of the wrong type, `.nan` and `.inf` are errors, never
warnings. A number in quotes is a text. A section with nothing below its name takes its defaults.

## Where YAML surprises

YAML 1.1 reads some plain words and numbers in ways that few people mean. In a file, `fishd` refuses
these, with the line and what to write instead:

| written | YAML reads | write |
|---|---|---|
| `lock_memory: on` (or off, yes, no, y, n) | `true`, `false` | `true`, `false`, or in quotes |
| `tick: 1e-2` | the text "1e-2" | `1.0e-2` or `0.01` |
| `tick: 1:30` | ninety, in sixties | a plain number |
| `priority: 010` | eight, in octal | `10` |
| the same key twice in one section | the second one | the key once |

## Every key

An interval such as (0, 2] permits what is above 0 and up to 2, 2 included.
"""

ANY = {
    "number": "any number",
    "integer": "any number",
    "text": "a text",
    "boolean": "`true`, `false`",
    "section": "keys and values",
}
"""What is permitted where there are no bounds."""

HEADINGS = "| key | unit | permitted | default | description |\n|---|---|---|---|---|\n"


def reference() -> str:
    """The whole text of docs/configuration.md."""
    return PREAMBLE + "".join(_sections(Config(), ""))


def _sections(section: Struct, prefix: str) -> Iterator[str]:
    """A heading and a table for a section, then the same for each section inside it."""
    plain, nested = [], []
    for field in fields_of(type(section)):
        value = getattr(section, field.name)
        if isinstance(value, Struct):
            nested.append((field, value))
        else:
            plain.append(_row(field, value, prefix))
    if plain:
        yield f"\n{HEADINGS}" + "".join(plain)
    for field, value in nested:
        name = prefix + field.name
        yield f"\n### `{name}`\n\n{field.description}\n"
        yield from _sections(value, name + ".")


def _row(field: Field, default: object, prefix: str) -> str:
    permitted = field.interval or ANY[field.kind]
    if field.kind == "integer":
        permitted += ", whole"
    if field.optional:
        permitted += ", or `null`"
    unit = "" if field.unit == "1" else field.unit
    value = f"`{_spelled(default)}`"
    cells = (f"`{prefix}{field.name}`", unit, permitted, value, field.description)
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |\n"


def _spelled(value: object) -> str:
    """A value as one writes it in YAML."""
    text: str = yaml.safe_dump(value, default_flow_style=True)
    return text.removesuffix("\n").removesuffix("\n...")


@click.command()
@click.option("--check", is_flag=True, help="Write nothing; exit 1 when the file is out of date.")
def main(check: bool) -> None:
    """Write docs/configuration.md from the schema of the configuration."""
    text = reference()
    current = TARGET.read_text(encoding="utf-8") if TARGET.exists() else None
    if text == current:
        return
    if check:
        click.echo("docs/configuration.md is out of date: run tools/config_reference.py", err=True)
        sys.exit(1)
    TARGET.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

"""Writer of the table of rooms in docs/: the purpose of each, and the rooms that it imports.

A room is a package or a module at the top of fishd/, except `__main__.py`, which starts the
commands; an arrow is a pair of rooms of which the first imports the second, in any of its files.

`tools/rooms.py --write` writes the table into the page; `--check` exits with 1 where it is out of
date.
"""

import ast
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from common.report import table, write_reference

FISHD = Path(__file__).resolve().parents[1] / "fishd"


def rooms(folder: Path = FISHD) -> dict[str, Path]:
    """Return the path of each room by its name in the page: `core/`, `assembly.py`."""
    packages = {f"{path.parent.name}/": path.parent for path in folder.glob("*/__init__.py")}
    modules = {path.name: path for path in folder.glob("*.py") if "__" not in path.stem}
    return dict(sorted({**packages, **modules}.items()))


def purpose(room: Path) -> str:
    """Return the first line of a room's docstring; empty where it has none."""
    file = room / "__init__.py" if room.is_dir() else room
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return docstring.partition("\n")[0]


def arrows() -> set[tuple[str, str]]:
    """Return each pair of rooms of which the first imports the second."""
    names = {path.stem: name for name, path in rooms().items()}
    pairs = {
        (module.split(".")[1], imported.split(".")[1])
        for module, others in imports().items()
        for imported in others
    }
    return {(names[one], names[other]) for one, other in pairs if one != other and one in names}


@cache
def imports() -> dict[str, set[str]]:
    """Return the other modules of fishd that each module imports, anywhere in its file.

    An import of a module from its package is one of the package, too.
    """
    files = {_module_name(path): path for path in FISHD.rglob("*.py")}
    del files["fishd"]  # its version, which every module may import
    graph = {}
    for module, path in files.items():
        names = _imported_names(ast.parse(path.read_text(encoding="utf-8")))
        imported = {part for name in names for part in (name, name.rpartition(".")[0])}
        graph[module] = imported & files.keys() - {module}
    return graph


def _module_name(file: Path) -> str:
    parts = file.relative_to(FISHD.parent).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


def _imported_names(tree: ast.Module) -> Iterator[str]:
    """Yield the dotted name of whatever is imported: of modules, and of what is in them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def layers() -> list[str]:
    """Return the module names of the rooms as import-linter checks them, from top to bottom."""
    project = tomllib.loads((FISHD.parent / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    contract = next(contract for contract in contracts if contract["type"] == "layers")
    return [name.strip() for layer in contract["layers"] for name in layer.split(":")]


def summary() -> str:
    """Return the table of rooms, from top to bottom, and the number of arrows."""
    pairs, order = arrows(), layers()
    rows = [
        [f"`{name}`", purpose(path), ", ".join(b for a, b in sorted(pairs) if a == name) or "–"]
        for name, path in sorted(rooms().items(), key=lambda room: order.index(room[1].stem))
    ]
    head = table("in `fishd/` | what it is | imports", rows)
    return f"{head}\n\n{len(rows)} rooms, {len(pairs)} arrows."


if __name__ == "__main__":
    sys.exit(write_reference("rooms", [("explanation/rooms.md", "rooms", summary())]))

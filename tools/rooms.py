"""Prints the rooms of fishd/, what each is for, and which others it imports.

A room is a package or a module at the top of fishd/; an arrow is a pair of them of which one
imports the other, wherever in it.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

from common.report import table

FISHD = Path(__file__).resolve().parents[1] / "fishd"


def rooms(folder: Path = FISHD) -> dict[str, Path]:
    """Where each room is, by its name as in README: `core/`, `__main__.py`."""
    packages = {f"{path.parent.name}/": path.parent for path in folder.glob("*/__init__.py")}
    modules = {path.name: path for path in folder.glob("*.py") if path.stem != "__init__"}
    return dict(sorted({**packages, **modules}.items()))


def purpose(room: Path) -> str:
    """The first line of its docstring; empty where it has none."""
    file = room / "__init__.py" if room.is_dir() else room
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return docstring.partition("\n")[0]


def arrows(folder: Path = FISHD) -> set[tuple[str, str]]:
    """Every pair of rooms of which the first imports the second."""
    found = rooms(folder)
    by_module = {path.stem: name for name, path in found.items()}
    pairs = {
        (name, by_module[imported])
        for name, path in found.items()
        for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])
        for imported in _imported(ast.parse(file.read_text(encoding="utf-8")), folder.name)
        if imported in by_module
    }
    return {(one, other) for one, other in pairs if one != other}


def _imported(tree: ast.Module, package: str) -> Iterator[str]:
    """What stands behind the name of the package in each import."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            first, *rest = name.split(".")
            if first == package and rest:
                yield rest[0]


def main() -> None:
    """Print the table, and count."""
    pairs = arrows()
    rows = [
        [f"`{name}`", purpose(path), ", ".join(b for a, b in sorted(pairs) if a == name)]
        for name, path in rooms().items()
    ]
    print(table("in `fishd/` | what it is | imports", rows))
    print(f"\n{len(rows)} rooms, {len(pairs)} arrows")


if __name__ == "__main__":
    main()

"""The tests themselves: what they share stands in helper modules, not in one another."""

import re
from collections import Counter

from rigs.documents import ROOT


def test_no_test_module_imports_another() -> None:
    importing = re.compile(r"^\s*(?:from|import) (?:\w+\.)*test_\w+", re.MULTILINE)
    files = sorted((ROOT / "tests").rglob("*.py"))
    assert [str(file) for file in files if importing.search(file.read_text("utf-8"))] == []


def test_no_two_test_modules_have_the_same_name() -> None:
    """pytest cannot collect both: their folders are no packages."""
    names = Counter(file.name for file in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []

"""The notebooks in docs/, run from their first cell to their last."""

import ast
import json
from pathlib import Path
from typing import Any

import pytest
from rigs.documents import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def cells_of(notebook: Path) -> list[dict[str, Any]]:
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def run(code: str, variables: dict[str, Any]) -> Any:
    """Run a cell; return the value of its last expression, which a notebook shows."""
    *statements, last = ast.parse(code).body
    if not isinstance(last, ast.Expr):
        statements.append(last)
    exec(compile(ast.Module(statements, []), "cell", "exec"), variables)
    if isinstance(last, ast.Expr) and not code.rstrip().endswith(";"):
        return eval(compile(ast.Expression(last.value), "cell", "eval"), variables)
    return None


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_as_it_stands(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from matplotlib import pyplot

    monkeypatch.chdir(tmp_path)  # what it writes is nowhere else
    variables: dict[str, Any] = {"__name__": "__main__"}
    pictures = 0
    with pyplot.rc_context({"backend": "agg"}):
        for cell in cells_of(path):
            shown = run("".join(cell["source"]), variables)
            figures = pyplot.get_fignums()
            assert shown is not None or figures or capsys.readouterr().out, "a cell shows nothing"
            pictures += len(figures)
            pyplot.close("all")
    assert pictures == 3


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_its_outputs(path: Path) -> None:
    assert not [cell for cell in cells_of(path) if cell["outputs"] or cell["execution_count"]]

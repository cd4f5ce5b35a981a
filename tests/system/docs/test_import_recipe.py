"""The Python example of docs/how-to/recording.md that records a table, run unchanged."""

import sys
from pathlib import Path

from rigs.documents import FENCE, ROOT, text_of
from rigs.processes import call

from fishd.recording import open_run

PAGE = ROOT / "docs" / "how-to" / "recording.md"


def test_the_recipe_records_a_table_of_a_spreadsheet(tmp_path: Path) -> None:
    blocks = FENCE.findall(text_of(PAGE))
    (block,) = (block for kind, block in blocks if kind == "python" and "make_ticks" in block)
    rows = [f"{number / 20:g};{number};{(-1) ** (number // 6) * 0.4}" for number in range(100)]
    table = "\n".join(("t;Fx (mN);servo", *rows)).replace(".", ",")
    (tmp_path / "forces.csv").write_text(table, encoding="utf-8")
    done = call(sys.executable, "-W", "error", "-c", block, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    run = open_run(tmp_path / "rig.mcap")
    assert [tick.fx for tick in run.ticks] == [1e-3 * number for number in range(100)]
    assert run.summary.swim_ticks.keys() == {"imported"}

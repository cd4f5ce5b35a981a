"""Tables of experiments, which are safe in spreadsheets and readable by fishd."""

from pathlib import Path

from fishd.lab.tables import Table, read


def test_a_spreadsheet_computes_nothing_and_every_text_is_read_back(tmp_path: Path) -> None:
    row = {"policy": "=1+1.onnx", "=mode": "@auto", "thrust": -0.5}
    table = Table(tmp_path / "points.csv", row)
    table.add(row)
    assert table.path.read_text() == "policy,'=mode,thrust\n'=1+1.onnx,'@auto,-0.5\n"
    assert read(table.path) == [list(row), ["=1+1.onnx", "@auto", "-0.5"]]


def test_a_table_that_a_spreadsheet_has_saved_is_read(tmp_path: Path) -> None:
    table = tmp_path / "points.csv"
    table.write_bytes("\ufefffrequency,thrust\r\n1.5,0.02\r\n".encode())
    assert read(table) == [["frequency", "thrust"], ["1.5", "0.02"]]

"""Files of other programs, of spreadsheets and of power cuts: each is read, or refused in one line.

What a user sees of each is in a table.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rigs.inputs_of_others import FILES, TICKS, as_text, swum_table, write_all
from rigs.processes import fishctl, one_line
from rigs.recording_verbs import VERBS, find_mistakes, run_verb

from fishd.lab.experiment import HEADER, RESULT, ROWS
from fishd.recording import open_run

WITHOUT_METADATA = (
    "not as recorded: its metadata are missing, which mcap filter keeps with --include-metadata "
    "and --include-attachments"
)
LINES = {
    "filtered-by-time": "not as recorded: 30 ticks instead of 60",
    "filtered-by-topic": "not as recorded: 0 events instead of 3",
    "filtered-without-metadata": WITHOUT_METADATA,
    "merged-with-a-copy": "not as recorded: 120 ticks instead of 60; 6 events instead of 3; "
    "repeated messages are read once",
    "merged-with-another": "",
    "copied-to-the-last-message": "",
    "with-records-of-others": "",
    "with-a-chunk-of-an-unknown-opcode": "not as recorded: 50 ticks instead of 60",
    "with-a-chunk-of-a-private-opcode": "not as recorded: 50 ticks instead of 60",
    "with-an-unknown-chunk-and-no-end": "not as recorded: 50 ticks instead of 60",
    "half-and-then-zeros": "damaged: an unknown number of ticks lost",
    "whole-chunks-and-then-zeros": "damaged: an unknown number of ticks lost",
    "followed-by-another": "not as recorded: BYTES bytes after its end are not read: another "
    "recording, which tail -c BYTES extracts",
    "followed-by-zeros": "not as recorded: 512 bytes after its end are not read",
}
"""Message of every verb about a file, by name; empty for one that differs in nothing."""
HELD_TICKS = {
    **dict.fromkeys(LINES, 50),
    "filtered-by-time": 30,
    "filtered-by-topic": TICKS,
    "filtered-without-metadata": TICKS,
    "merged-with-a-copy": TICKS,
    "merged-with-another": TICKS + 20,
    "copied-to-the-last-message": TICKS,
    "with-records-of-others": TICKS,
    "half-and-then-zeros": 19,
    "whole-chunks-and-then-zeros": 19,
    "followed-by-another": TICKS,
    "followed-by-zeros": TICKS,
}
"""Number of ticks in each file, repeated ones counted once."""
LOST_TICKS = {"filtered-by-time": 30, **{name: 10 for name in LINES if name.startswith("with-a")}}
"""Number of lost ticks that runs shows, where it is not 0."""
NO_CONFIGURATION = " does not contain the configuration of its fishd"
"""Further message of rerun about a file without attachments."""
REFUSED = {
    "empty": "is empty, as a power cut may leave a file; delete it, there is nothing to recover",
    "zeros": "is not an MCAP file",
}
"""Message of every verb about a file of which nothing can be read."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("others")
    write_all(folder)
    return folder


def test_the_tables_have_every_file() -> None:
    assert {f"{name}.mcap" for name in (*LINES, *REFUSED)} == set(FILES)
    assert set(HELD_TICKS) == set(LINES)


@pytest.fixture(autouse=True, scope="module")
def size_of_what_follows(folder: Path) -> None:
    size = (folder / "good.mcap").stat().st_size
    LINES["followed-by-another"] = LINES["followed-by-another"].replace("BYTES", str(size))


def test_runs_counts_what_is_in_a_file_and_says_what_was_recorded(folder: Path) -> None:
    listed = fishctl("runs", "--folder", str(folder), "--json")
    runs = {run["name"]: run for run in json.loads(listed.stdout)}
    assert {name: run["problem"] for name, run in runs.items()} == {**LINES, "good": ""}
    assert {name: runs[name]["ticks"] for name in LINES} == HELD_TICKS
    assert {
        name: runs[name]["lost_ticks"] for name in LINES if runs[name]["lost_ticks"]
    } == LOST_TICKS
    assert runs["filtered-by-time"]["duration"] == pytest.approx(29 * 0.05)
    assert runs["merged-with-a-copy"]["thrust"] == runs["good"]["thrust"]
    assert runs["merged-with-a-copy"]["restarts"] == 0
    errors = {f"fishctl: {folder / name}.mcap {line}" for name, line in REFUSED.items()}
    assert set(listed.stderr.splitlines()) == errors
    shown = fishctl("runs", "--folder", str(folder)).stdout
    assert all(line in shown for line in LINES.values())


@pytest.mark.parametrize("name", [*LINES, *REFUSED])
def test_every_verb_says_in_one_line_how_a_file_differs(
    folder: Path, tmp_path: Path, name: str
) -> None:
    file = folder / f"{name}.mcap"
    for verb in VERBS.keys() - {"runs", "runs --json", "plot", "recover"}:
        outcome = run_verb(verb, file, tmp_path)
        assert find_mistakes(outcome) == []
        lines = [line.removeprefix(f"fishctl: {file}") for line in outcome.err.splitlines()]
        if name in REFUSED:
            assert lines == [f" {REFUSED[name]}"], verb
        else:
            said = [line for line in lines if line != NO_CONFIGURATION]
            assert said == ([f": {LINES[name]}"] if LINES[name] else []), verb


def test_an_identification_says_it_too(folder: Path) -> None:
    file = folder / "filtered-by-time.mcap"
    said, ended, *more = fishctl("identify", str(file)).stderr.splitlines()
    assert said == f"fishctl: {file}: {LINES['filtered-by-time']}"
    assert ended.startswith("fishctl: there is no passage of 5 s without a gap")
    assert not more


def test_records_of_others_cost_neither_ticks_nor_the_configuration(folder: Path) -> None:
    run, good = open_run(folder / "with-records-of-others.mcap"), open_run(folder / "good.mcap")
    assert (run.ticks, run.events, run.config) == (good.ticks, good.events, good.config)


@pytest.mark.parametrize(
    ("name", "ticks"),
    [
        ("half-and-then-zeros", 19),
        ("with-a-chunk-of-a-private-opcode", 50),
        ("merged-with-a-copy", TICKS),
        ("followed-by-another", TICKS),
    ],
)
def test_a_repaired_file_still_says_what_it_lacks(
    folder: Path, tmp_path: Path, name: str, ticks: int
) -> None:
    file = tmp_path / f"{name}.mcap"
    file.write_bytes((folder / file.name).read_bytes())
    done = fishctl("recover", str(file))
    assert done.stdout.endswith(f"; {LINES[name]}\n")
    repaired = open_run(tmp_path / f"{name}-recovered.mcap")
    assert repaired.is_as_recorded
    assert len(repaired.ticks) == ticks
    said = f"recovered: {LINES[name]}"
    assert said in fishctl("runs", "--folder", str(tmp_path)).stdout
    done = fishctl("export", str(repaired.path), "--csv", "--to", str(tmp_path))
    assert done.stderr == f"fishctl: {repaired.path}: {said}\n"


SHORT_SWIM = ("--jobs", "1", "--periods", "2", "--settle", "1")
SWEEP = ("sweep", "square", "--frequency", "1.5,2", *SHORT_SWIM)
EMPTY = (
    "it has no complete line; delete it to measure everything again, or choose a new folder with "
    "--folder"
)
FOLDERS: dict[str, tuple[str, Callable[[bytes], bytes], str | None]] = {
    "a table of Excel": (
        ROWS,
        lambda rows: b"\xef\xbb\xbf" + rows.replace(b"\n", b"\r\n"),
        None,
    ),
    "an empty table": (ROWS, lambda _: b"", EMPTY),
    "a table without its first line end": (ROWS, lambda rows: rows[:20], EMPTY),
    "a table of zeros": (ROWS, lambda rows: bytes(len(rows)), EMPTY),
    "an empty header": (HEADER, lambda _: b"", "truncated; choose a new folder with --folder"),
    "half a header": (HEADER, lambda text: text[: len(text) // 2], "choose a new folder with"),
    "an empty result": (RESULT, lambda _: b"", None),
}
"""File of an experiment, its damage, and what a resume says; None if it is resumed."""


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("experiments") / "swept"
    done = fishctl(*SWEEP, "--folder", str(folder))
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.parametrize("case", FOLDERS)
def test_a_damaged_file_of_an_experiment_is_a_line_with_a_remedy(
    swept: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    name, damage, line = FOLDERS[case]
    file = swept / name
    whole = file.read_bytes()
    try:
        file.write_bytes(damage(whole))
        listed = fishctl("runs", "--folder", str(swept.parent))
        assert "Traceback" not in listed.stderr
        done = fishctl("sweep", "--resume", str(swept))
        if line is None:
            assert (done.returncode, done.stderr) == (0, "")
            assert "2 of them measured already" in done.stdout
        else:
            said = one_line(done)
            assert f"{file}: " in said
            assert line in said
    finally:
        file.write_bytes(whole)


ROWS_OF_A_RIG = swum_table()
HEAD = "time_s,fx_N,fy_N,phi_c_rad"
NAMES = ("--columns", HEAD)
DEGREES = ROWS_OF_A_RIG * [1e3, 1e3, 1e3, 180 / np.pi]
TABLES: dict[str, tuple[str | bytes, tuple[str, ...], str]] = {
    "CSV": (as_text(ROWS_OF_A_RIG, head=HEAD), (), ""),
    "CSV of Excel": ("\ufeff" + as_text(ROWS_OF_A_RIG, head=HEAD).replace("\n", "\r\n"), (), ""),
    "UTF-16": (as_text(ROWS_OF_A_RIG, head=HEAD).encode("utf-16"), (), ""),
    "an empty line after each row": (
        as_text(ROWS_OF_A_RIG, head=HEAD).replace("\n", "\r\r\n"),
        (),
        "",
    ),
    "decimal commas": (as_text(ROWS_OF_A_RIG, ";", HEAD.replace(",", ";"), decimal=","), (), ""),
    "decimal commas between tabs": (as_text(ROWS_OF_A_RIG, "\t", decimal=","), NAMES, ""),
    "decimal commas between spaces": (as_text(ROWS_OF_A_RIG, "  ", decimal=","), NAMES, ""),
    "commas and spaces": (as_text(ROWS_OF_A_RIG, ", ", "# " + HEAD), NAMES, ""),
    "no header": (as_text(ROWS_OF_A_RIG), NAMES, ""),
    "a header of two lines, with a degree sign of Windows": (
        b"t;Fx;Fy;servo\ns;N;N;\xb0\n" + as_text(ROWS_OF_A_RIG, ";").encode(),
        NAMES,
        "",
    ),
    "other units": (as_text(DEGREES, head="time_ms,Fx_mN,Fy_mN,PHI_C_deg"), (), ""),
    "a separator at the end of each line": (
        as_text(ROWS_OF_A_RIG, ";").replace("\n", ";\n"),
        NAMES,
        "",
    ),
    "a rate instead of times": (
        as_text(ROWS_OF_A_RIG[:, 1:]),
        ("--columns", "fx,fy,phi_c", "--rate", "20"),
        "",
    ),
    "a row without a number": (
        as_text(ROWS_OF_A_RIG[:9], head=HEAD) + "0.5,nan,,0\n" + as_text(ROWS_OF_A_RIG[10:]),
        (),
        "1 row left out, in which a number is missing",
    ),
    "a row without its last number": (
        as_text(ROWS_OF_A_RIG[:9], head=HEAD) + "0.45,1,1,\n" + as_text(ROWS_OF_A_RIG[10:]),
        (),
        "1 row left out, in which a number is missing",
    ),
    "a column of its own": (
        as_text(ROWS_OF_A_RIG[:, [0, 1, 2, 3, 1]], head=f"{HEAD},tip_x_mm"),
        (),
        "kept as quantities: tip_x_mm",
    ),
    "no servo": (
        as_text(ROWS_OF_A_RIG[:, :3]),
        ("--columns", "time,fx,fy"),
        "without phi_c: identify cannot use it",
    ),
    "markers": (
        as_text(DEGREES[:, [0, 1, 3]], " "),
        ("--columns", "time_ms,-,alpha_deg"),
        "without fx, fy, phi_c: identify cannot use it",
    ),
}
"""Text of a table of another rig, options of import, and what it says on standard error."""
SAVE = "save the table as CSV (UTF-8)"
BAD_TABLES: dict[str, tuple[str | bytes, tuple[str, ...], str]] = {
    "nothing": ("", NAMES, "it is empty: a table of numbers is needed"),
    "no numbers": (f"{HEAD}\n", (), "no line of numbers in the columns that are named"),
    "one row": (f"{HEAD}\n0,1,1,0\n", (), "two rows of numbers or more are needed"),
    "names of another program": (
        "Time,Force X,Force Y\n0,1,2\n1,1,2\n",
        (),
        "its first line names neither force nor angle; name the columns in order, such as "
        "--columns time_s,fx_mN,fy_mN,phi_c_deg",
    ),
    "no names": ("0,1,2\n1,1,2\n", (), "its first line names neither force nor angle; name"),
    "a unit of another country": (
        "time,fx_lbf\n0,1\n1,1\n",
        (),
        "column 'fx_lbf': its unit must be one of fx_N, fx_mN, fx_g",
    ),
    "times in ms without their unit": (
        "time,fx\n0,1\n50,1\n100,1\n",
        (),
        "most rows are 50 s apart: is the time in milliseconds (time_ms)? If not, state --rate "
        "0.02",
    ),
    "times of a clock in ms without their unit": (
        "time,fx\n1.7e12,1\n1.7000001e12,1\n",
        (),
        "time is 1.7e+12 s somewhere, more than 1e+10 s: is it in milliseconds (time_ms) or "
        "microseconds (time_us)?",
    ),
    "degrees without their unit": (
        "time,phi_c\n0,20\n1,-20\n",
        (),
        "phi_c is 20 rad somewhere, more than 3.14 rad: is it in degrees (phi_c_deg)?",
    ),
    "degrees of a fin without their unit": (
        "time,alpha\n0,20\n1,-20\n",
        (),
        "alpha is 20 rad somewhere, more than 3.14 rad: is it in degrees (alpha_deg)?",
    ),
    "mN without their unit": (
        "time,fx\n0,250\n1,1\n",
        (),
        "fx is 250 N somewhere, more than 100 N: is it in mN (fx_mN)?",
    ),
    "mW without their unit": (
        "time,fx,power\n0,1,20000\n1,1,1\n",
        (),
        "power is 2e+04 W somewhere, more than 1e+04 W: is it in mW (power_mW)?",
    ),
    "thousands beside decimal points": (
        'time,fx_mN\n0,999.5\n1,"1,000"\n2,"1,234"\n3,998.5\n',
        (),
        "its numbers have both '.' and ',': 999.5 in line 2 and 1,000 in line 3; save it without "
        "separators of thousands",
    ),
    "thousands between semicolons": (
        "time;fx_mN\n0;999.5\n1;1,000\n",
        (),
        "its numbers have both '.' and ',': 999.5 in line 2 and 1,000 in line 3",
    ),
    "thousands beside decimal commas": (
        "time;fx_mN\n0;1,5\n1;1.000\n",
        (),
        "its numbers have both '.' and ',': 1,5 in line 2 and 1.000 in line 3",
    ),
    "thousands and decimals in the first number": (
        "fx_mN;fy_mN\n1,234.5;2,345.6\n999.5;1\n1;1\n",
        ("--rate", "10"),
        "its numbers have both '.' and ',': 1,234.5 in line 2",
    ),
    "thousands alone": (
        "time;fx_mN\n0;999\n1;1,000\n2;1,234\n",
        (),
        "1,000 beside 999: it is unclear whether ',' separates thousands or decimals; save it "
        "without separators of thousands, or with as many decimals in each number",
    ),
    "German thousands alone": (
        "time;fx_mN\n0;999\n1;1.000\n",
        (),
        "1.000 beside 999: it is unclear whether '.' separates thousands or decimals",
    ),
    "a number of Python": ("time,fx\n0,1_0\n1,1\n", (), "line 2, fx: '1_0' is not a number"),
    "a rate that the times contradict": (
        "time,fx\n0,1\n0.05,1\n0.1,1\n",
        ("--rate", "1"),
        "most rows are 0.05 s apart, not 1 s as --rate 1 states: leave that out, or the times "
        "('-')",
    ),
    "a workbook": (b"PK\3\4\x14\0", (), f"it is not a text: {SAVE}"),
    "a compressed table": (b"\x1f\x8b\x08", (), f"it is not a text: {SAVE}"),
    "a page": ("\n<!DOCTYPE html>", (), "its first line names neither force nor angle"),
    "UTF-16 without its mark": (
        f"{HEAD}\n".encode("utf-16-le"),
        (),
        f"it is not a text: {SAVE}",
    ),
    "a name twice": ("fx,FX\n0,1\n1,1\n", ("--rate", "10"), "two columns are named 'fx'"),
    "neither times nor a rate": (
        "fx,fy\n0,1\n1,1\n",
        (),
        "without a column 'time', the rate is needed: --rate HZ",
    ),
    "times that do not increase": (
        as_text(ROWS_OF_A_RIG[[0, 1, 2, 1]], head=HEAD),
        (),
        "the times do not increase: 0.1 s, then 0.05 s, in rows 3 and 4 of the numbers; sort the "
        "rows by time, or leave the times out ('-') and state --rate HZ",
    ),
    "a time of another clock": (
        "time,fx\n0,1\n1e-6,1\n2e-6,1\n1e9,1\n",
        (),
        "two rows are 1e+09 s apart, most are 1e-06 s: is the unit of time right?",
    ),
    "a text": (
        "time,fx\n0,1\n1,n/a\n",
        (),
        "line 3, fx: 'n/a' is not a number such as 1000.5; leave the cell empty where one is "
        "missing",
    ),
    "a column too few": (
        "0,1\n1,1\n",
        NAMES,
        "line 1 has 2 columns, not 4: name each with --columns, '-' for one to leave out",
    ),
    "a force of no fish": (
        "time,fx\n0,1\n1,1e300\n",
        (),
        "fx is 1e+300 N somewhere, more than 100 N",
    ),
    "a picture": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(99), NAMES, f"it is not a text: {SAVE}"),
}
"""The same for tables that are refused."""


def write_table(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("case", TABLES)
def test_a_table_of_another_rig_becomes_a_recording(tmp_path: Path, case: str) -> None:
    content, options, said = TABLES[case]
    path = write_table(tmp_path / "rig.csv", content)
    done = fishctl("import", str(path), *options, "--folder", str(tmp_path), "--json")
    assert done.returncode == 0, done.stderr
    assert (said in done.stderr) if said else (done.stderr == "")
    run = open_run(tmp_path / "rig.mcap")
    rows = {tick.seq: tick for tick in run.ticks}
    for number, (time, fx, fy, phi_c) in enumerate(ROWS_OF_A_RIG, start=1):
        tick = rows.get(number)
        if tick is None:
            assert number == 10
            assert case.startswith("a row without")
            continue
        if "rate" not in case:
            assert tick.time == pytest.approx(time)
        if case == "markers":
            assert tick.alpha == pytest.approx(phi_c)
            continue
        assert (tick.fx, tick.fy) == pytest.approx((fx, fy), rel=1e-7)
        assert tick.phi_c == pytest.approx(0.0 if case == "no servo" else phi_c, rel=1e-7)
    (listed,) = json.loads(fishctl("runs", "--folder", str(tmp_path), "--json").stdout)
    assert (listed["problem"], listed["about"]["source"]) == ("", "import")
    assert listed["lost_ticks"] == case.startswith("a row without")


@pytest.mark.parametrize("case", BAD_TABLES)
def test_a_table_that_cannot_be_used_is_one_line(tmp_path: Path, case: str) -> None:
    content, options, said = BAD_TABLES[case]
    path = write_table(tmp_path / "rig.csv", content)
    done = fishctl("import", str(path), *options, "--folder", str(tmp_path))
    line = one_line(done)
    assert line.startswith(f"fishctl: {path}: ")
    assert said in line
    assert list(tmp_path.iterdir()) == [path]


def test_rounded_times_are_not_gaps(tmp_path: Path) -> None:
    rows = "".join(f"{row / 96:.2f},1\n" for row in range(960))
    path = write_table(tmp_path / "rig.csv", f"time,fx\n{rows}")
    for rate in ((), ("--rate", "96")):
        done = fishctl("import", str(path), f"{tmp_path}/run{len(rate)}", *rate, "--json")
        assert json.loads(done.stdout)["lost_ticks"] == 0
        times = [tick.time for tick in open_run(tmp_path / f"run{len(rate)}.mcap").ticks]
        assert np.diff(times) == pytest.approx(1 / 96, rel=1e-3)


def test_a_missing_row_of_rounded_times_is_a_gap(tmp_path: Path) -> None:
    rows = "".join(f"{row / 48:.2f},1\n" for row in range(960) if row != 3)
    path = write_table(tmp_path / "rig.csv", f"time,fx\n{rows}")
    done = fishctl("import", str(path), "--folder", str(tmp_path), "--json")
    assert json.loads(done.stdout)["lost_ticks"] >= 1


def test_a_name_with_a_line_break_is_refused(tmp_path: Path) -> None:
    path = write_table(tmp_path / "rig.csv", "time,fx\n0,1\n1,1\n")
    line = one_line(fishctl("import", str(path), "a\nb", "--folder", str(tmp_path)))
    assert line == "fishctl: 'a\\nb' is not a valid name of a recording\n"
    assert list(tmp_path.iterdir()) == [path]


def test_what_fishd_measured_it_measures_again_in_a_table(tmp_path: Path) -> None:
    """The thrust of an imported table has the interval that fishd itself gave to the swim."""
    from fishd.config import Config
    from fishd.lab.identification import identify
    from fishd.lab.session import VirtualSession

    with VirtualSession(Config()) as session, session.recorded(tmp_path / "own.mcap", "own"):
        session.rest(8.0)
        session.swim("square", {"frequency": 1.7}, 25.0)
        session.rest(8.0)
    own = open_run(tmp_path / "own.mcap")
    rows = np.array([(tick.time, tick.fx, tick.fy, tick.phi_c) for tick in own.ticks])
    path = write_table(tmp_path / "rig.csv", as_text(rows, ";", decimal=","))
    samples = str(own.ticks[1].samples)
    done = fishctl("import", str(path), *NAMES, "--samples", samples, "--folder", str(tmp_path))
    assert re.fullmatch(r"\S+rig\.mcap: 41\.0 s, 820 ticks, 0 lost: time, .*\n", done.stdout)
    imported = open_run(tmp_path / "rig.mcap")
    thrust, ci95 = imported.summary.thrust, imported.summary.thrust_ci95
    assert thrust == pytest.approx(own.summary.thrust, abs=0.1e-3)
    assert ci95 == pytest.approx(own.summary.thrust_ci95, rel=0.1)
    fits = [identify(run.path, fit=["omega0"]) for run in (own, imported)]
    assert fits[0]["omega0"].value == pytest.approx(fits[1]["omega0"].value, rel=1e-3)

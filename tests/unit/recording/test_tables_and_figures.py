"""Tables and figures of a recording."""

import json
import re
from pathlib import Path

import numpy as np
import pandas
import pyarrow.parquet
import pytest
from mcap.records import Schema
from rigs.harness import Rig
from rigs.processes import fishctl, one_line
from rigs.recordings import record_run, swum, write

from fishd.lab.run_figure import draw_run
from fishd.lab.run_traces import MIN_FORCE_SPAN, limits, mean_beat, spectrum, traces
from fishd.recording import RunWriter, open_run


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    return record_run(swum(), folder / "run", note="<b>stiff</b> & $new_{$")


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_a_table_has_every_bit_of_every_tick(path: Path, tmp_path: Path, form: str) -> None:
    done = fishctl("export", str(path), f"--{form}", "--to", str(tmp_path))
    table, events = map(Path, done.stdout.split())
    reader = {"csv": pandas.read_csv, "parquet": pandas.read_parquet}[form]
    exported = reader(table)
    assert list(exported.columns) == list(open_run(path).frame().columns)
    for name in ("t", "fx", "fin_velocity", "phi_c", "thrust"):
        assert exported[name].tolist() == [getattr(tick, name) for tick in open_run(path).ticks]
    assert reader(events)["kind"].tolist() == ["controller", "mode", "parameters"]
    again = fishctl("export", str(path), f"--{form}", "--to", str(tmp_path))
    assert "already exists; use --force to replace it" in one_line(again)
    assert fishctl("export", str(path), f"--{form}", "--to", str(tmp_path), "--force").stdout
    named = fishctl("export", str(path), "--to", str(tmp_path / f"other.{form}"))
    assert named.stdout.split() == [
        str(tmp_path / f"other{part}.{form}") for part in ("", "-events")
    ]
    if form == "parquet":
        about = json.loads(pyarrow.parquet.read_schema(table).metadata[b"fishd"])
        assert about["configs"]["0"]["tick"] == 0.05


@pytest.mark.slow  # to load matplotlib takes seconds
def test_a_recording_is_drawn_as_a_picture(path: Path, tmp_path: Path) -> None:
    done = fishctl("plot", str(path), "--to", str(tmp_path), "--from", "0.5")
    assert Path(done.stdout.strip()).read_bytes().startswith(b"\x89PNG")
    drawn = fishctl("plot", str(path), "--to", str(tmp_path / "only.svg"), "--json")
    assert json.loads(drawn.stdout) == [str(tmp_path / "only.svg")]
    refused = fishctl("plot", str(path), "--to", str(tmp_path))
    assert "already exists; use --force to replace it" in one_line(refused)
    nothing = fishctl("plot", str(path), "--from", "9", "--to", str(tmp_path))
    assert "no tick between these times; the recording is 3.0 s long" in one_line(nothing)


@pytest.mark.slow
def test_an_interval_is_in_the_legend_where_there_is_one(tmp_path: Path) -> None:
    known = Rig()
    known.run_for(10)
    known.start("swing")
    known.run_for(5)
    for rig, expected in ((swum(), False), (known, True)):
        name = f"known-{expected}"
        drawn = traces(open_run(record_run(rig, tmp_path / name)))
        draw_run(drawn, tmp_path / f"{name}.svg")
        assert ("95 %" in (tmp_path / f"{name}.svg").read_text()) == expected


def test_a_curve_has_breaks_and_events_and_units_are_said(path: Path, tmp_path: Path) -> None:
    ticks = swum().recorder.ticks
    drawn = traces(open_run(write(tmp_path / "run", ticks[:20] + ticks[30:])))
    assert len(drawn.time) == 51
    assert [index for index, value in enumerate(drawn.fx) if value != value] == [20]
    expected = ["swing C=0.6 longest_half_period=1 s lead=0 s", "C=0.3"]
    assert [event.text for event in traces(open_run(path)).events] == expected
    assert list(drawn.quantities) == [
        *("power", "top_speed", "reversal_speed", "since_reversal (s)")
    ]


def test_readings_of_sensors_are_columns_curves_and_means_with_their_units(tmp_path: Path) -> None:
    rig = Rig("sensors.water={kind: simulated, value: 21, amplitude: 0, low: 0, high: 20}")
    rig.start("square", frequency=2).run(20)
    with RunWriter(tmp_path / "run") as writer:
        writer.describe(rig.config, {}, rig.loop.readings.declared)
        for tick in rig.recorder.ticks:
            writer.tick(tick)
    run = open_run(writer.path)
    assert run.reading_units == {"power": "W", "water_temperature": "°C"}
    table = run.frame()
    assert table["readings.water_temperature"].tolist()[2:] == [21.0] * 18
    assert {"power (W)", "water_temperature (°C)"} <= traces(run).quantities.keys()
    assert run.summary.readings == {
        "power": pytest.approx(table["readings.power"].mean()),
        "water_temperature": 21.0,
    }
    (schema,) = {
        record.data
        for _, record in run.records()
        if isinstance(record, Schema) and record.name == "fishd.Tick"
    }
    properties = json.loads(schema)["properties"]["readings"]["properties"]
    assert properties["water_temperature"]["description"] == "Simulated reading. [°C]"


def test_spectrum_and_mean_beat_of_a_swim_show_its_frequency_and_no_gap(tmp_path: Path) -> None:
    rig = Rig("simulation.noise=0").start("square", frequency=1.25, amplitude=0.4)
    rig.run_for(12)
    ticks = rig.recorder.ticks
    drawn = traces(open_run(write(tmp_path / "run", ticks[:60] + ticks[80:])))
    assert drawn.portrait
    spectral, beat = spectrum(drawn, drawn.portrait), mean_beat(drawn, drawn.portrait)
    assert spectral
    assert beat
    assert spectral.frequency[spectral.fy.argmax()] == pytest.approx(1.25, abs=0.06)
    assert spectral.fy.max() == pytest.approx(np.abs(np.fft.rfft(beat.fy)[1]) / 8, rel=0.02)
    assert list(beat.phase * 16 - 0.5) == list(range(16))
    half = np.roll(beat.fy, 8)
    assert np.abs(beat.fy + half).max() < 0.02 * np.ptp(beat.fy)  # both strokes are alike
    assert spectrum(drawn, slice(0, 20)) is None
    assert mean_beat(drawn, slice(0, 20)) is None


def test_a_resting_fish_has_no_phase_portrait_and_dust_is_not_blown_up(tmp_path: Path) -> None:
    rig = Rig("simulation.noise=0")
    rig.run_for(1)
    drawn = traces(open_run(record_run(rig, tmp_path / "run")))
    assert drawn.portrait is None
    low, high = limits(MIN_FORCE_SPAN, drawn.fx, drawn.fy)
    assert high - low == pytest.approx(1.0)
    low, high = limits(MIN_FORCE_SPAN, drawn.fx + 500.0, drawn.fy)
    assert low < 0 < 500 < high


def test_recordings_are_listed_with_what_is_missing(path: Path, tmp_path: Path) -> None:
    ticks = swum().recorder.ticks
    write(tmp_path / "second", ticks[:20] + ticks[30:])
    (tmp_path / "broken.mcap").write_text("nothing")
    done = fishctl("runs", "--folder", str(tmp_path))
    assert re.search(r"^second .* 50 +10 +0  swing", done.stdout, re.MULTILINE)
    assert "broken.mcap is not an MCAP file" in done.stderr
    (listed,) = json.loads(fishctl("runs", "--json", "--folder", str(path.parent)).stdout)
    assert (listed["name"], listed["state"], listed["lost_ticks"]) == ("run", "finished", 0)
    nothing = fishctl("runs", "--folder", str(tmp_path / "none"))
    assert "there is no recording in" in nothing.stdout

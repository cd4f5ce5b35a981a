"""Dated files of calibrations: never overwritten, and the newest is used."""

import contextlib
import datetime
import resource
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from msgspec import Struct, inspect

from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.errors import ConfigError
from fishd.hardware.calibration_files import CalibrationFolder
from fishd.hardware.settings import ServoSettings

NOON = datetime.datetime(2026, 11, 21, 12, 0, 0, tzinfo=datetime.UTC)
HOUR = datetime.timedelta(hours=1)


def test_the_last_one_that_was_saved_is_in_force_with_its_date(tmp_path: Path) -> None:
    folder = CalibrationFolder(tmp_path / "new" / "pi")
    assert folder.newest(ForceCalibration) is None
    folder.save(ForceCalibration(xx=1.5), NOON)
    saved, path = folder.save(ForceCalibration(xx=2.5), NOON + HOUR)
    assert folder.newest(ForceCalibration) == (saved, path)
    assert (saved.xx, saved.date) == (2.5, "2026-11-21T13:00:00+00:00")
    assert folder.newest(ServoCalibration) is None


@pytest.mark.parametrize("step_back", [0 * HOUR, 1 * HOUR, 24 * 365 * HOUR])
def test_a_clock_gone_back_brings_no_older(tmp_path: Path, step_back: datetime.timedelta) -> None:
    folder = CalibrationFolder(tmp_path)
    for number in range(1, 5):
        folder.save(ForceCalibration(xx=float(number)), NOON - (number > 1) * step_back)
        newest = folder.newest(ForceCalibration)
        assert newest[0].xx == number
    assert len(list(tmp_path.iterdir())) == 4


def test_a_time_zone_does_not_decide_which_is_newer(tmp_path: Path) -> None:
    folder = CalibrationFolder(tmp_path)
    summer = datetime.timezone(2 * HOUR)
    winter = datetime.timezone(1 * HOUR)
    folder.save(ForceCalibration(xx=1.0), datetime.datetime(2026, 10, 25, 2, 50, tzinfo=summer))
    after = datetime.datetime(2026, 10, 25, 2, 10, tzinfo=winter)
    _, later = folder.save(ForceCalibration(xx=2.0), after)
    assert "2026-10-25T011000" in later.name
    newest = folder.newest(ForceCalibration)
    assert newest[1] == later


FORCE = {"xx": 1.0, "xy": 0.0, "x0": 0.0, "yx": 0.0, "yy": 1.0, "y0": 0.0, "date": "2026-11-21"}
SERVO = {"trim": 0.0, "direction": 1, "scale": 600.0, "lowest": -1.2, "highest": 1.2}


def error_message(folder: Path, kind: type[ForceCalibration | ServoCalibration], text: str) -> str:
    """Return the message for a file with this text."""
    name = "force" if kind is ForceCalibration else "servo"
    path = folder / f"{name}-2027-01-01T000000.000000Z.yaml"
    CalibrationFolder(folder).save(kind(), NOON)  # an older file, which must not be used instead
    path.write_text(text)
    with pytest.raises(ConfigError) as refusal:
        CalibrationFolder(folder).newest(kind)
    path.unlink()
    line = str(refusal.value)
    assert line.startswith(f"{path}:")
    assert line.endswith("; repair the file, or move it away")
    assert "\n" not in line
    return line


@pytest.mark.parametrize("key", ["xy", "date", "scale"])
def test_a_file_without_one_of_its_keys_is_not_filled_in(tmp_path: Path, key: str) -> None:
    kind, whole = (ForceCalibration, FORCE) if key in FORCE else (ServoCalibration, SERVO)
    text = yaml.safe_dump({name: value for name, value in whole.items() if name != key})
    assert f"{key} missing: " in error_message(tmp_path, kind, text)


@pytest.mark.parametrize("length", range(0, 80, 20))
def test_a_torn_file_is_an_error(tmp_path: Path, length: int) -> None:
    _, path = CalibrationFolder(tmp_path).save(ForceCalibration(xx=1.5, xy=-0.25), NOON)
    text = path.read_text()
    assert length < text.index("loads:") - 1
    assert error_message(tmp_path, ForceCalibration, text[:length])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("xx: [", ":1: not valid YAML"),
        ("", "the file is empty"),
        ("- 1.0\n", "a mapping of keys to values is needed"),
        ("xx: 1.0\nxy: 0.0\nx0: 0.0\nyx: 0.0\n", "yy, y0, date missing: fishd fills in no default"),
    ],
)
def test_a_file_that_is_no_calibration_is_an_error(tmp_path: Path, text: str, words: str) -> None:
    assert words in error_message(tmp_path, ForceCalibration, text)


@pytest.mark.parametrize(
    ("kind", "whole", "changes", "words"),
    [
        (ForceCalibration, FORCE, {"xx": float("nan")}, "xx: nan is not a finite number"),
        (ForceCalibration, FORCE, {"xx": "lots"}, "xx: 'lots' is not valid"),
        (ForceCalibration, FORCE, {"xxx": 1.0}, "xxx: unknown key"),
        (ForceCalibration, FORCE, {"date": ""}, "date: '' is not a date: one in ISO 8601"),
        (ForceCalibration, FORCE, {"date": "soon"}, "date: 'soon' is not a date: one in ISO 8601"),
        (ForceCalibration, FORCE, {"xx": 0.0, "yy": 0.0}, "xx xy, yx yy is singular"),
        (ForceCalibration, FORCE, {"xy": 2.0, "yx": 0.5}, "xx xy, yx yy is singular"),
        (ForceCalibration, FORCE, {"covariance_x": [-1.0, 0.0, 1.0]}, "is not a covariance"),
        (ForceCalibration, FORCE, {"covariance_y": [1.0, 2.0, 1.0]}, "is not a covariance"),
        (ForceCalibration, FORCE, {"covariance_x": [1.0, 0.0]}, "covariance_x: [1.0, 0.0] is not"),
        (ForceCalibration, FORCE, {"load_ci95": -0.1}, "load_ci95: -0.1 is negative"),
        (ServoCalibration, SERVO, {"highest": 3.15}, "highest: 3.15 is not valid"),
    ],
)
def test_a_file_that_makes_no_sense_is_an_error_that_says_where(
    tmp_path: Path,
    kind: type[ForceCalibration | ServoCalibration],
    whole: dict[str, object],
    changes: dict[str, object],
    words: str,
) -> None:
    assert words in error_message(tmp_path, kind, yaml.safe_dump({**whole, **changes}))


def bounds(struct: type[Struct], name: str) -> object:
    """Return the type of a field, with its bounds."""
    info = inspect.type_info(struct)
    kind = next(field.type for field in info.fields if field.name == name)
    return kind.type if isinstance(kind, inspect.Metadata) else kind


def test_a_servo_calibration_has_the_bounds_of_the_same_keys_of_the_configuration() -> None:
    for key in SERVO:
        assert bounds(ServoCalibration, key) == bounds(ServoSettings, key), key


def test_an_uncertainty_is_kept_with_its_calibration(tmp_path: Path) -> None:
    folder = CalibrationFolder(tmp_path)
    calibration = ForceCalibration(covariance_x=(1e-4, -1e-5, 2e-4), covariance_y=(1e-4, 0.0, 1e-4))
    folder.save(calibration, NOON)
    newest = folder.newest(ForceCalibration)
    assert newest[0].covariance_x == calibration.covariance_x
    assert newest[0].thrust_ci95(0.025) == pytest.approx(1.96e-2 * 0.025)


def test_a_folder_that_cannot_be_read_is_an_error_and_not_no_calibration(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be read"):
        CalibrationFolder(tmp_path / "file").newest(ForceCalibration)


@pytest.mark.parametrize(
    "name",
    ["force-backup", "force-2027-01-01T000000.000000Z (copy)", "force-2027-02-30T000000.000000Z"],
)
def test_a_file_without_a_date_in_its_name_is_ignored_and_told(tmp_path: Path, name: str) -> None:
    folder = CalibrationFolder(tmp_path)
    force, _ = folder.save(ForceCalibration(xx=2.0), NOON)
    servo, _ = folder.save(ServoCalibration(trim=3.0), NOON)
    assert folder.ignored() == []
    file = tmp_path / f"{name}.yaml"
    file.write_text("xx: 7.0\n")
    newest = folder.newest(ForceCalibration), folder.newest(ServoCalibration)
    assert [pair and pair[0] for pair in newest] == [force, servo]
    assert folder.ignored() == [f"{file} is not a dated calibration file and is ignored"]
    _, path = folder.save(ForceCalibration(xx=3.0), NOON + HOUR)
    assert path.name == "force-2026-11-21T130000.000000Z.yaml"


@contextlib.contextmanager
def full_disk() -> Iterator[None]:
    """Limit the size of new files to 0 bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_save_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    folder = CalibrationFolder(tmp_path)
    with full_disk(), pytest.raises(OSError, match="too large"):
        folder.save(ForceCalibration(), NOON)
    assert list(tmp_path.iterdir()) == []


def test_volts_count_as_newtons_until_a_matrix_was_found_whatever_was_tared() -> None:
    assert ForceCalibration().is_unset
    assert ForceCalibration(x0=0.1, tare_date="2026-11-21", date="2026-11-21").is_unset
    assert not ForceCalibration(loads=5).is_unset
    assert not ForceCalibration(xx=2.0).is_unset

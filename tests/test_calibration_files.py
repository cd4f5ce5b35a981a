"""The dated files that calibrations are kept in: never overwritten, the newest in force."""

import datetime
from pathlib import Path

import pytest

from fishd.errors import ConfigError
from fishd.hardware.calibration import CalibrationFolder, ForceCalibration, ServoCalibration

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
def test_a_clock_that_goes_back_does_not_put_an_older_one_in_force(
    tmp_path: Path, step_back: datetime.timedelta
) -> None:
    folder = CalibrationFolder(tmp_path)
    for number in range(1, 5):
        folder.save(ForceCalibration(xx=float(number)), NOON - (number > 1) * step_back)
        found = folder.newest(ForceCalibration)
        assert found is not None
        assert found[0].xx == number
    assert len(list(tmp_path.iterdir())) == 4


def test_a_time_zone_does_not_decide_which_is_newer(tmp_path: Path) -> None:
    folder = CalibrationFolder(tmp_path)
    summer = datetime.timezone(2 * HOUR)
    winter = datetime.timezone(1 * HOUR)
    folder.save(ForceCalibration(xx=1.0), datetime.datetime(2026, 10, 25, 2, 50, tzinfo=summer))
    _, later = folder.save(
        ForceCalibration(xx=2.0), datetime.datetime(2026, 10, 25, 2, 10, tzinfo=winter)
    )
    assert "2026-10-25T011000" in later.name
    found = folder.newest(ForceCalibration)
    assert found is not None
    assert found[1] == later


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("xx: [", ":1: not valid YAML"),
        ("xx: lots\n", "xx: 'lots' is not valid"),
        ("xxx: 1.0\n", "xxx: unknown key"),
        ("xx: 1e2\n", "1e2"),
    ],
)
def test_a_broken_file_is_an_error_and_no_older_one_is_taken_for_it(
    tmp_path: Path, text: str, words: str
) -> None:
    folder = CalibrationFolder(tmp_path)
    folder.save(ForceCalibration(xx=1.0), NOON)
    newer = tmp_path / "force-2027.yaml"
    newer.write_text(text)
    with pytest.raises(ConfigError) as refusal:
        folder.newest(ForceCalibration)
    assert str(newer) in str(refusal.value)
    assert words in str(refusal.value)


def test_a_folder_that_cannot_be_read_is_an_error_and_not_no_calibration(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be read"):
        CalibrationFolder(tmp_path / "file").newest(ForceCalibration)


def test_what_is_half_written_is_not_a_calibration(tmp_path: Path) -> None:
    (tmp_path / "force-2027.part").write_text("xx: ")
    assert CalibrationFolder(tmp_path).newest(ForceCalibration) is None

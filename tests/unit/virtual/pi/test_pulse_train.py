"""Pulses of an emulated pin: frames, changes between them, pulses cut short."""

import pytest

from fishd.virtual.pi.pulse_train import PulseTrain


@pytest.fixture
def train() -> PulseTrain:
    return PulseTrain()


def test_a_new_width_takes_effect_with_the_next_frame(train: PulseTrain) -> None:
    train.set(0.0, 1500.0)
    train.set(0.1001, 1600.0)
    assert train.width(0.1199) == 1500.0
    assert train.width(0.12) == 1600.0


@pytest.mark.parametrize("frame", [1, 95, 12_345_679])
def test_a_change_as_a_frame_begins_takes_effect_at_once(train: PulseTrain, frame: int) -> None:
    time = frame / 50
    train.set(time, 1500.0)
    assert train.width(time) == 1500.0
    assert train.level(time) == 1


def test_of_several_changes_in_one_frame_the_last_one_counts(train: PulseTrain) -> None:
    train.set(0.001, 1500.0)
    train.set(0.002, 1600.0)
    assert train.history == [(0.02, 1600.0)]
    train.set(0.101, 1700.0)
    train.set(0.102, 1600.0)
    assert train.history == [(0.02, 1600.0)]


def test_the_level_is_high_for_the_width_of_the_pulse(train: PulseTrain) -> None:
    train.set(0.0, 1500.0)
    assert [train.level(0.04 + after) for after in (0.0, 0.00149, 0.0015, 0.0199)] == [1, 1, 0, 0]


def test_switching_off_completes_the_pulse_under_way(train: PulseTrain) -> None:
    train.set(0.0, 1500.0)
    train.set(0.0401, 0.0)
    assert train.level(0.0414) == 1
    assert train.width(0.06) == 0.0


def test_cutting_shortens_the_pulse_under_way(train: PulseTrain) -> None:
    train.set(0.0, 1500.0)
    train.cut(0.0407)
    assert train.level(0.0408) == 0
    assert train.width(0.0408) == pytest.approx(700.0)
    assert train.width(0.06) == 0.0


def test_shorter_frames_begin_where_the_longer_one_ends(train: PulseTrain) -> None:
    train.set(0.0, 1500.0)
    train.set(0.101, 1600.0, frame=0.003)
    assert train.width(0.1199) == 1500.0
    assert train.width(0.1201) == 1600.0
    assert train.level(0.1231) == train.level(0.1201 + 0.0031) == 1

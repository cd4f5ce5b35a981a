"""Conditions in which the force sensor marks its forces as suspect."""

import pytest
from rigs.force_rig import ForceRig, Ticks, measurements


def test_a_frozen_channel_is_suspected_after_its_time_and_only_then(rig: ForceRig) -> None:
    ticks = Ticks(rig.sensor(frozen_after=1.0))
    measurements(ticks.run(1.0))
    rig.faults.inject("frozen-code", 1.5)
    suspects = [measured.suspect for measured in measurements(ticks.run(1.5))]
    assert not any(suspects[:19])
    assert all(suspects[22:])
    assert suspects[-1].startswith("F_x (channel A0-A1) has been frozen at +0.5")
    assert not any(measured.suspect for measured in measurements(ticks.run(1.0))[1:])


def test_a_quiet_signal_is_believed_where_frozen_codes_are_permitted() -> None:
    with ForceRig(noise=0.0) as rig:
        ticks = Ticks(rig.sensor(frozen_after=None))
        assert not any(measured.suspect for measured in measurements(ticks.run(5.0)))


def test_a_code_that_is_the_same_after_a_gap_was_not_frozen_for_all_that_time() -> None:
    with ForceRig(noise=0.0) as rig:
        ticks = Ticks(rig.sensor(frozen_after=1.0))
        ticks.run(0.5)
        rig.faults.inject("unplugged", 2.0)
        ticks.run(2.5)
        assert not measurements(ticks.run(0.2))[-1].suspect


@pytest.mark.parametrize("bits", [16, 12])
@pytest.mark.parametrize(("volts", "end"), [(3.0, "+2.048"), (-3.0, "-2.048")])
def test_a_clipped_channel_is_named_with_its_limit(volts: float, end: str, bits: int) -> None:
    with ForceRig(bits=bits) as rig:
        rig.volts["A2-A3"] = volts
        measured = Ticks(rig.sensor()).next()
    assert measured.suspect == f"F_y (channel A2-A3) is clipped at {end} V"


@pytest.mark.parametrize(("volts", "key"), [(3.28, "saturation_high"), (-3.28, "saturation_low")])
def test_an_amplifier_at_its_supply_is_suspected(rig: ForceRig, volts: float, key: str) -> None:
    rig.volts["A2-A3"] = volts
    measured = Ticks(rig.sensor(full_scale=4.096)).next()
    assert measured.suspect.startswith("F_y (channel A2-A3) is at ")
    assert measured.suspect.endswith(f"the amplifier is at its end (force_sensor.{key})")


@pytest.mark.parametrize(("low", "suspected"), [(0.1, True), (-3.2, False)])
def test_an_amplifier_with_one_output_ends_at_0(rig: ForceRig, low: float, suspected: bool) -> None:
    rig.volts = {"A0": 0.02, "A1": 1.65}
    sensor = rig.sensor(channel_x="A0", channel_y="A1", full_scale=4.096, saturation_low=low)
    suspect = Ticks(sensor).next().suspect
    assert (suspect is not None) == suspected
    assert not suspect or suspect.startswith("F_x (channel A0) is at +0.0")


def test_where_the_amplifier_has_another_supply_the_whole_range_is_believed(rig: ForceRig) -> None:
    rig.volts["A0-A1"] = 4.0
    ends = {"saturation_low": None, "saturation_high": None}
    ticks = Ticks(rig.sensor(full_scale=4.096, force_limit=100.0, **ends))
    assert not any(measured.suspect for measured in measurements(ticks.run(0.5)))


def test_a_force_beyond_the_limit_is_suspected_though_the_mean_is_within(rig: ForceRig) -> None:
    rig.volts["A2-A3"] = lambda t: -1.2 if 0.020 < t < 0.026 else 0.0
    suspect = Ticks(rig.sensor(force_limit=1.0)).next().suspect
    assert suspect.startswith("F_y is -1.2 N, beyond force_sensor.force_limit, 1 N")


def test_a_suspicion_is_of_its_own_window_and_not_of_reads_without_a_sample(rig: ForceRig) -> None:
    rig.volts["A0-A1"] = lambda t: 3.0 if t < 0.1 else 0.5  # in the first conversion only
    results = Ticks(rig.sensor(data_rate=8)).run(1.5)
    read = [item for item in results if not isinstance(item, str)]
    assert "is clipped" in read[0].suspect
    assert [measured.samples for measured in read[1:4]] == [0, 0, 0]
    assert not any(measured.suspect or measured.extremes for measured in read[1:4])
    assert not any(measured.suspect for measured in read[1:])

"""What people are shown of the fin angle: its maximum per beat, and its lag."""

import math

import numpy as np
import pytest

from fishd.camera.tail_watch import TailWatch
from fishd.core.tail_reading import TailReading

HZ, LAG, LARGEST = 1.3, 0.18, 0.2
TICK = 0.05


def reading(time: float, alpha: float | None, reason: str = "") -> TailReading:
    return TailReading(time=time, alpha=alpha, zero=0.0, uncertainty=0.002, reason=reason)


def swum(until: float = 6.0, lag: float = LAG, connected: float = 0.0) -> TailWatch:
    """Return what is known after a square wave, and a fin angle that follows it.

    connected: time from which the instruction angles are known [s]
    """
    watch = TailWatch()
    for time in np.arange(connected, until, TICK):
        watch.add_command(time, 0.4 if time * HZ % 1.0 < 0.5 else -0.4)
    for time in np.arange(0.0, until, 1 / 30):
        watch.add(reading(time, LARGEST * math.sin(math.tau * HZ * (time - lag))))
    return watch


def test_the_maximum_is_that_of_the_peaks_between_the_pictures() -> None:
    assert swum().alpha_max == pytest.approx(LARGEST, rel=5e-3)


@pytest.mark.parametrize("lag", [0.05, LAG, 0.6])
def test_the_lag_behind_a_square_wave_is_that_of_its_fundamental(lag: float) -> None:
    # A command holds from its tick: its reversals lie up to a tick after those of the wave.
    assert swum(lag=lag).lag == pytest.approx(lag - 0.5 * TICK, abs=0.5 * TICK)


def test_the_lag_is_known_as_soon_as_a_beat_of_instruction_angles_is() -> None:
    assert swum(connected=4.0).lag == pytest.approx(swum().lag, abs=0.5 * TICK)
    assert swum(connected=5.5).lag is None


def test_a_line_says_all_of_it() -> None:
    words = swum().describe().split(", ")
    assert words[0].startswith("fin angle ")
    assert words[0].endswith(" ± 0.002 rad")
    assert words[1] == "maximum 0.200 rad"
    assert words[2].endswith(" ms after φ_c")


def test_what_is_not_known_is_not_said() -> None:
    watch = TailWatch()
    assert (watch.describe(), watch.alpha_max, watch.lag) == ("no fin angle", None, None)
    watch.add(reading(0.0, 0.1))
    assert watch.describe() == "fin angle +0.100 ± 0.002 rad"
    watch.add(reading(0.1, None, "something else moves"))
    assert watch.describe() == "fin angle unknown: something else moves"


def test_angles_of_another_clock_replace_those_before() -> None:
    watch = swum()
    watch.add(reading(-100.0, 0.1))
    assert watch.alpha_max is None

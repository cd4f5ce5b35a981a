"""Mean beat and spectrum of a recording, against waves whose integrals are known."""

import numpy as np
import pytest

from fishd.lab.run_traces import Array, MeanBeat, Traces, mean_beat, spectrum

TICK = 0.05
MEAN, DOUBLE, SINGLE, LAG = 14.0, 25.0, 280.0, 1.1  # mN, mN, mN, rad


def swum(frequency: float, wave: str, seconds: float = 20.0) -> Traces:
    """Return forces of a beat as their means between ticks, and a command that holds for a tick.

    F_x = MEAN + DOUBLE cos(2θ), F_y = SINGLE sin(θ - LAG), where θ = 2π f t is the command's phase.
    """
    time = TICK * np.arange(round(seconds / TICK))
    turn = 2.0 * np.pi * frequency

    def between(integral: Array) -> Array:
        return np.diff(integral, prepend=np.nan) / TICK

    fx = between(MEAN * time + DOUBLE * np.sin(2.0 * turn * time) / (2.0 * turn))
    fy = between(-SINGLE * np.cos(turn * time - LAG) / turn)
    phi_c = np.sin(turn * time + 1e-6)
    phi_c = phi_c if wave == "sine" else np.sign(phi_c)
    nothing = np.full_like(time, np.nan)
    return Traces(
        "", "mN", time[1:], fx[1:], fy[1:], 0.4 * phi_c[1:], nothing, nothing, nothing, nothing,
        None, None, {}, None, [],
    )  # fmt: skip


def phase_of(beat: MeanBeat, values: Array, harmonic: int) -> float:
    """Return the phase of a harmonic over the beat [rad]."""
    return float(np.angle(np.sum(values * np.exp(-2j * np.pi * harmonic * beat.phase))))


@pytest.mark.parametrize("frequency", [0.7, 1.3, 1.6667, 2.1])
def test_the_mean_beat_has_the_phase_and_the_mean_of_the_forces(frequency: float) -> None:
    traces = swum(frequency, "sine")
    beat = mean_beat(traces, slice(None))
    delay = np.pi * frequency * TICK  # a command holds for a tick, so its beat begins later
    lag = phase_of(beat, beat.fy, 1) + 0.5 * np.pi
    assert lag == pytest.approx(delay - LAG, abs=np.radians(1.0))
    assert phase_of(beat, beat.fx, 2) == pytest.approx(2.0 * delay, abs=np.radians(2.0))
    assert beat.fx.mean() == pytest.approx(MEAN, rel=0.002)


@pytest.mark.parametrize("ticks", [5, 6, 8])
def test_a_square_wave_begins_its_beat_when_the_command_changes(ticks: int) -> None:
    frequency = 0.5 / (ticks * TICK)
    beat = mean_beat(swum(frequency, "square"), slice(None))
    assert len(beat.phase) == 2 * ticks
    lag = phase_of(beat, beat.fy, 1) + 0.5 * np.pi
    assert lag == pytest.approx(-LAG, abs=np.radians(0.5))
    assert beat.fx.mean() == pytest.approx(MEAN, rel=1e-6)


@pytest.mark.parametrize("frequency", [1.0, 1.27, 1.625, 1.6667, 1.683])
def test_a_peak_has_the_amplitude_of_its_wave_between_frequencies_too(frequency: float) -> None:
    spectral = spectrum(swum(frequency, "sine"), slice(None))
    averaged = np.sinc(frequency * TICK)
    assert spectral.fy.max() == pytest.approx(SINGLE * averaged, rel=0.005)
    assert spectral.fx.max() == pytest.approx(DOUBLE * np.sinc(2 * frequency * TICK), rel=0.005)


def test_the_densities_add_up_to_the_variance_of_the_forces() -> None:
    traces = swum(1.27, "sine")
    noise = np.random.default_rng(7).normal(0.0, 3.0, len(traces.time))
    noisy = traces._replace(fy=noise)
    spectral = spectrum(noisy, slice(None))
    step = spectral.frequency[1] - spectral.frequency[0]
    assert step * spectral.fy_density.sum() == pytest.approx(noise.var(), rel=0.15)
    assert step * spectral.fx_density.sum() == pytest.approx(traces.fx.var(), rel=0.01)

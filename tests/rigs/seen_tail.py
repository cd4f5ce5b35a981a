"""A stand-in for a camera that measures the fin angle of a simulated fish, from its ticks."""

import numpy as np
from msgspec import UNSET

from fishd.core.camera_frames import FrameHead, Pixels
from fishd.core.signals import Event, Tick
from fishd.core.tail_reading import RecordedTail
from fishd.lab.session import Session


class SeenTail:
    """Listener of a session that is also the camera of its fin angles, with known errors."""

    def __init__(
        self,
        session: Session,
        *,
        rate: float = 30.0,
        delay: float = 0.02,
        zero: float = 0.01,
        scale: float = 1.0,
        noise: float = 2e-3,
    ) -> None:
        """
        delay: of the time stamps [s]; zero, noise: [rad]
        session: the camera hears it from now on
        """
        self._period, self._delay, self._zero, self._scale = 1.0 / rate, delay, zero, scale
        self._noise, self._chance = noise, np.random.default_rng(0)
        self._before: Tick | None = None
        self._next, self._count = 0.0, 0
        self.glare = 0.0
        """Fraction of pictures whose fin angle is unknown."""
        self._tails: list[RecordedTail] = []
        session._listeners.append(self)

    def tick(self, tick: Tick) -> None:
        before, self._before = self._before, tick
        assert tick.alpha is not UNSET
        assert tick.alpha_rate is not UNSET
        if before is None:
            self._next = tick.time
            return
        assert before.alpha is not UNSET
        assert before.alpha_rate is not UNSET
        span = tick.time - before.time
        while self._next < tick.time:
            s = (self._next - before.time) / span
            t = 1.0 - s
            alpha = (
                (1.0 + 2.0 * s) * t * t * before.alpha
                + (1.0 + 2.0 * t) * s * s * tick.alpha
                + span * s * t * (t * before.alpha_rate - s * tick.alpha_rate)
            )
            self._add(self._next + self._delay, alpha, tick.t - tick.time)
            self._next += self._period

    def _add(self, time: float, alpha: float, ahead: float) -> None:
        measured = self._scale * alpha + self._zero + self._noise * self._chance.normal()
        self._count += 1
        glares = self._chance.random() < self.glare
        self._tails.append(
            RecordedTail(
                time=time,
                alpha=None if glares else float(measured),
                reason="glare" if glares else "",
                zero=0.0,
                uncertainty=1.96 * self._noise,
                t=time + ahead,
                seq=self._count,
                session="seen",
            )
        )

    def event(self, event: Event) -> None:
        pass

    def set_time(self, t: float, monotonic: float) -> None:
        pass

    def take(self) -> tuple[list[str], list[tuple[FrameHead, Pixels]]]:
        return [], []

    def take_tails(self) -> list[RecordedTail]:
        tails, self._tails = self._tails, []
        return tails

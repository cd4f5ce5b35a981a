"""Swim in virtual time with a simulated camera: forces and frames on one clock."""

from itertools import pairwise

from fishd.camera.latency import Force
from fishd.camera.simulated import SimulatedCamera, SimulatedCameraSettings, Tail
from fishd.cli.camera.latency import force_windows
from fishd.config import load
from fishd.core.camera_frames import Frame
from fishd.core.signals import Tick
from fishd.lab.session import VirtualSession
from rigs.harness import PINNED_TICK

NOISY = (PINNED_TICK, "simulation.noise=1e-3", "simulation.offset_y=5e-3", "simulation.drift=5e-3")


def swum(seconds: float, *overrides: str, controller: str = "excitation") -> list[Tick]:
    with VirtualSession(load(None, (*NOISY, *overrides))) as rig:
        return rig.swim(controller, {}, seconds)


def filmed(ticks: list[Tick], camera: SimulatedCameraSettings) -> list[Frame]:
    simulated = SimulatedCamera(camera, 84)
    tails = [Tail(t.time, float(t.alpha), float(t.alpha_rate)) for t in ticks]  # type: ignore[arg-type]
    return [frame for pair in pairwise(tails) for frame in simulated.frames(*pair)]


def felt(ticks: list[Tick]) -> list[Force]:
    return force_windows(ticks, 0.05)

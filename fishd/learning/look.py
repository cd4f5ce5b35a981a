"""Sensitivity of a policy to parts of its pictures: the change of its action when they are hidden.

A patch of the mean picture is slid over the frames of a swim, as in Zeiler and Fergus, "Visualizing
and understanding convolutional networks" (2014). The gradient of the action by the pixels misleads:
it is large at the edges of all bright objects.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import find_motion
from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config
from fishd.controllers.policy import library
from fishd.controllers.policy.card import Card, History
from fishd.controllers.policy.file import OUTPUT, PolicyFile
from fishd.controllers.policy.runtime import Network, Pilot
from fishd.core.camera_frames import Stack
from fishd.core.errors import PolicyError
from fishd.core.signals import Observation
from fishd.lab.drawing import BLUE, open_figure
from fishd.learning.env.evaluation import judge
from fishd.learning.links.simulated_link import Camera

SWIM_S, SETTLE_S = 15.0, 5.0
"""Length of the swim, and of its beginning that is left out [s]."""
STACKS = 40
"""Number of evenly spread ticks of the swim in which parts are hidden."""
PATCH = 7
"""Width and height of a frame, in patches."""

Floats = NDArray[np.float64]
Seen = tuple[Observation, Stack]


class Sensitivity(NamedTuple):
    """The sensitivity of a policy to the parts of its pictures."""

    mean: Floats
    """Mean picture in grey levels, shape (size, size)."""
    sensitivity: Floats
    """Root mean square of the change of the action where a patch is hidden, before the cut to ±1,
    in units of Φ, shape (size, size)."""
    moves: NDArray[np.bool_]
    """Mask of the pixels where the tail moves, shape (size, size)."""

    @property
    def share(self) -> float:
        """Share of the sensitivity that lies where the tail moves."""
        return float(self.sensitivity[self.moves].sum() / self.sensitivity.sum())

    @property
    def area(self) -> float:
        """Share of the picture in which the tail moves."""
        return float(self.moves.mean())


def look(
    policy: str,
    config: Config,
    camera: SimulatedCameraSettings,
    seconds: float = SWIM_S,
) -> Sensitivity:
    """Let a policy swim a simulated fish, and compute its sensitivity to parts of the pictures.

    policy: name or path
    seconds: length of the swim, of which the first `SETTLE_S` are left out

    Raises `PolicyError` for a policy that sees no pictures, does not fit, or does not react to
    them, `NoMotion` where it does not swim, and `ParameterError` for too short a swim.
    """
    file = library.open_policy(policy, config.limits)
    if file.card.pictures is None:
        raise PolicyError(f"{file.path}: it sees no pictures, so it looks at nothing")
    seen = _record_swim(policy, config, Camera(camera, file.card.pictures), seconds)
    frames = np.stack([stack[0] for _, stack in seen])
    mean = frames.mean(axis=0)
    chosen = [seen[k] for k in np.linspace(0, len(seen) - 1, STACKS).astype(int)]
    sensitivity = _compute_sensitivity(_load_unclipped(file), chosen, mean, file.card)
    if not sensitivity.any():
        raise PolicyError(f"{file.path}: nothing in the pictures moves it")
    return Sensitivity(mean, sensitivity, find_motion(frames).energy > 0.0)


def _record_swim(policy: str, config: Config, camera: Camera, seconds: float) -> list[Seen]:
    """Return the observations and stacks of a swim, tick by tick."""
    pilot = Pilot(policy, config.limits)
    seen: list[Seen] = []
    first: list[float] = []

    def decide(observation: Observation, stack: Stack | None) -> float:
        first.append(observation.time)
        if stack is not None and observation.time >= first[0] + SETTLE_S:
            seen.append((observation, stack))
        return pilot.angle(observation, stack)

    judge(config, decide, seconds, SETTLE_S, camera)
    return seen


def _load_unclipped(file: PolicyFile) -> Network:
    """Return the network without the cut to ±1, which would hide changes of the action."""
    import onnx
    from onnx import helper

    model = onnx.load_model_from_string(file.content)
    for node in model.graph.node:
        if node.op_type == "Clip" and list(node.output) == [OUTPUT]:
            node.CopyFrom(helper.make_node("Identity", [node.input[0]], [OUTPUT]))
    return Network(file._replace(content=model.SerializeToString()))


def _compute_sensitivity(network: Network, seen: list[Seen], mean: Floats, card: Card) -> Floats:
    """Return `Sensitivity.sensitivity`: each pixel has the mean of the patches that hide it."""
    size = len(mean)
    patch = max(2, size // PATCH)
    begins = np.unique(np.linspace(0, size - patch, 2 * PATCH - 1).round().astype(int))
    hidden = mean.round().astype(np.uint8)
    squares = np.zeros((len(begins), len(begins)))
    history = History(card.observation, card.window, network.row)
    for observation, stack in seen:
        history.push(observation)
        whole = np.stack(stack)
        network.frames[:] = whole
        action = network.run()
        for i, top in enumerate(begins):
            for j, left in enumerate(begins):
                part = np.s_[:, top : top + patch, left : left + patch]
                network.frames[part] = hidden[part[1:]]
                squares[i, j] += (network.run() - action) ** 2
                network.frames[part] = whole[part]
    changes = np.sqrt(squares / len(seen))
    total, count = np.zeros_like(mean), np.zeros_like(mean)
    for i, top in enumerate(begins):
        for j, left in enumerate(begins):
            total[top : top + patch, left : left + patch] += changes[i, j]
            count[top : top + patch, left : left + patch] += 1.0
    sensitivity: Floats = total / count
    return sensitivity


def draw(path: str | os.PathLike[str], result: Sensitivity, title: str) -> None:
    """Draw a heat map of the sensitivity over the mean picture; a line bounds the moving tail.

    Raises as `fishd.lab.drawing.check` does.
    """
    strongest = float(result.sensitivity.max())
    with open_figure(Path(path), (4.4, 3.8)) as figure:
        axis = figure.subplots()
        axis.imshow(result.mean, cmap="gray", vmin=0.0, vmax=255.0)
        heat = axis.imshow(
            result.sensitivity,
            cmap="inferno",
            vmin=0.0,
            vmax=strongest,
            alpha=0.75 * result.sensitivity / strongest,
        )
        axis.contour(result.moves, levels=[0.5], colors=BLUE, linewidths=1.0)
        axis.set_title(title)
        axis.set_xlabel(
            f"{result.share:.0%} of the sensitivity where the tail moves\n"
            f"(blue line), {result.area:.0%} of the picture"
        )
        axis.set_xticks([])
        axis.set_yticks([])
        axis.spines[:].set_visible(False)
        bar = figure.colorbar(heat, ax=axis, shrink=0.9)
        bar.set_label("change of the action, rms (Φ)")
        if bar.solids:
            bar.solids.set_alpha(1.0)

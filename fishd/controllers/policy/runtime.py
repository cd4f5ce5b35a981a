"""Execution of the network of a policy file with onnxruntime, in the calling thread."""

import contextlib
import math
import os
import random
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fishd.controllers.base import Limits
from fishd.controllers.dwell import DwellLimit
from fishd.controllers.policy import library
from fishd.controllers.policy.card import History
from fishd.controllers.policy.file import FRAMES, INPUT, MISSING_PACKAGE, OUTPUT, PolicyFile
from fishd.core.camera_frames import Stack
from fishd.core.errors import PolicyError
from fishd.core.signals import Observation
from fishd.core.text import describe_error

HOLD_TIME_S = 0.25
"""Time for which the last angle is held without frames; then, and before the first frame, the angle
is neutral [s]. Half a beat of the default fish lasts 0.3 s, so a longer hold is not swimming."""
_PROBE_COUNT = 64
"""Number of inputs on which a network is tested, which also warms it up."""
_LARGEST_PROBE = 1e3
"""Largest test input, in units of a feature's scale."""
_TIMED_PROBES = 8
"""Number of first tests of which the fastest must be fast enough."""
_MAX_PROBE_TIME_S = 1.0
"""Total time after which a network is judged with fewer tests."""
_MAX_TICK_FRACTION = 0.5
"""Maximum time of one run, as a fraction of the tick."""


def load() -> Any:
    """Return the package onnxruntime without logs and telemetry; raise ImportError.

    By default, newer versions store an identifier of the device and send telemetry.
    """
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    onnxruntime.set_default_logger_severity(4)  # errors are raised as exceptions, too
    return onnxruntime


def preload() -> None:
    """Import onnxruntime, if it is installed.

    The import blocks all threads for longer than a tick, so call this before the first tick.
    """
    with contextlib.suppress(ImportError):
        load()


class Network:
    """A network that is ready to run: write to `frames` and `row`, then call `run`."""

    def __init__(self, policy: PolicyFile) -> None:
        """Load and warm up the network; raise `PolicyError` if it does not run."""
        card = policy.card
        pictures = card.pictures.shape if card.pictures else (0, 0, 0)
        frames = np.zeros((1, *pictures), np.uint8)
        inputs = np.zeros((1, card.numbers), np.float32)
        self.frames: NDArray[np.uint8] = frames[0]
        """Input pictures, shape (frames, size, size), newest first; empty without a camera."""
        self.row: NDArray[np.float32] = inputs[0]
        """Other inputs, shape (`card.numbers`,)."""
        self._output = np.zeros((1, 1), np.float32)
        try:
            self._session = _create_session(policy.content)
            self._binding = self._bound({FRAMES: frames, INPUT: inputs})
            self._try(card.tick)
        except PolicyError as error:
            raise PolicyError(f"{policy.path}: {error}") from None
        except Exception as error:  # onnxruntime has a separate class for each kind of error
            raise PolicyError(
                f"{policy.path}: onnxruntime cannot run it: {describe_error(error)}"
            ) from None

    def run(self) -> float:
        """Return the output for the inputs `frames` and `row`."""
        self._session.run_with_iobinding(self._binding)
        return float(self._output[0, 0])

    def _bound(self, inputs: Mapping[str, NDArray[Any]]) -> Any:
        """Bind inputs and output to fixed memory, which halves the time of a run."""
        value = load().OrtValue.ortvalue_from_numpy
        binding = self._session.io_binding()
        for name, array in inputs.items():
            if array.size:
                binding.bind_ortvalue_input(name, value(array))
        binding.bind_ortvalue_output(OUTPUT, value(self._output))
        return binding

    def _try(self, tick: float) -> None:
        """Raise `PolicyError` if an output is not finite, or all of several runs are too slow.

        Inputs of all magnitudes are tested, and pictures of all contrasts. The time is the CPU time
        of this thread, which does not depend on other load; tick: [s]
        """
        rng = random.Random(0)  # numpy.random would take 2 MB in each fishd
        sizes = np.geomspace(1e-3, _LARGEST_PROBE, _PROBE_COUNT)
        fastest, total = math.inf, 0.0
        for number, size in enumerate(sizes, 1):
            self.row[:] = [rng.gauss(0.0, size) for _ in self.row]
            self.frames[:] = _random_picture(rng, self.frames.shape)
            start = time.thread_time()
            output = self.run()
            elapsed = time.thread_time() - start
            fastest, total = min(fastest, elapsed), total + elapsed
            if not np.isfinite(output):
                what = f"the input {np.array2string(self.row)}" if self.row.size else "a picture"
                raise PolicyError(
                    f"its output is not finite for {what}; "
                    "train it again, or export an earlier checkpoint"
                )
            is_judged = number >= _TIMED_PROBES or total > _MAX_PROBE_TIME_S
            if is_judged and fastest > _MAX_TICK_FRACTION * tick:
                raise PolicyError(
                    f"this machine takes {fastest * 1e3:.3g} ms to run it once, more than half of "
                    f"its tick of {tick * 1e3:g} ms; train a smaller network"
                )


def _random_picture(rng: random.Random, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return noise around a random grey level, with a contrast from zero to black and white."""
    grey, contrast = rng.uniform(0.0, 255.0), rng.choice((0.0, 10.0, 300.0))
    noise = np.frombuffer(rng.randbytes(math.prod(shape)), np.uint8).reshape(shape) / 127.5 - 1.0
    return np.clip(grey + contrast * noise, 0.0, 255.0).astype(np.uint8)


def _create_session(content: bytes) -> Any:
    try:
        onnxruntime = load()
    except ImportError:
        raise PolicyError(f"it cannot be run: onnxruntime {MISSING_PACKAGE}") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


class Pilot:
    """Runner of a policy file, tick by tick, for one fish: observation in, angle out.

    For `fishctl agent` and for comparisons; within the loop, the controller `ppo` does the same.
    """

    def __init__(self, policy: str, limits: Limits) -> None:
        """
        policy: name or path
        limits: limits of the robot, including the shortest time between two reversals

        Raises `PolicyError` for a policy that does not fit, or does not run here.
        """
        policy_file = library.open_policy(policy, limits)
        self.card = policy_file.card
        self._network = Network(policy_file)
        self._history = History(self.card.observation, self.card.window, self._network.row)
        self._limit = DwellLimit(limits.dwell, limits, self.card.amplitude)
        self._angle = 0.0
        self._begun = False
        self.blind = 0.0
        """Time since the last frames [s]."""

    @property
    def waits(self) -> bool:
        """Whether it is at neutral because frames are missing."""
        return self.blind > HOLD_TIME_S

    def angle(self, observation: Observation, stack: Stack | None = None) -> float:
        """Return the angle for an observation [rad].

        stack: frames; None if they are incomplete

        Raise `ControllerFault` with the code `chatter`, see `DwellLimit`, and `PolicyError` for
        frames of another size and for an output that is not finite.
        """
        if not self._begun:
            self._begun = True
            self._limit.activate(observation.instruction_angle)
        self._history.push(observation)
        if self.card.pictures and stack is None:
            self.blind += observation.dt
            angle = 0.0 if self.waits else self._angle
        else:
            self.blind = 0.0
            angle = self._chosen(observation, stack)
        self._angle = self._limit.apply(angle, observation.dt)
        return self._angle

    def _chosen(self, observation: Observation, stack: Stack | None) -> float:
        network = self._network
        if self.card.pictures and stack is not None:
            self._show(stack)
        action = network.run()
        if not math.isfinite(action):
            raise PolicyError(f"the output of the policy is not finite: {action}")
        return self.card.amplitude * max(-1.0, min(1.0, action))

    def _show(self, stack: Stack) -> None:
        places = self._network.frames
        sizes = [frame.shape for frame in stack]
        if sizes != [place.shape for place in places]:
            count, height, width = places.shape
            raise PolicyError(
                f"it needs {count} frames of {height} x {width} pixels, but got frames of {sizes}"
            )
        for place, frame in zip(places, stack, strict=True):
            place[:] = frame

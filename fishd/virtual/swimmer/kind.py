"""The robot `swimmer`; what computes the fish is imported when it is opened."""

from typing import TYPE_CHECKING, Any

from fishd.core.errors import MissingPackage
from fishd.core.robots import RobotKind
from fishd.core.schema import Problem

if TYPE_CHECKING:
    from fishd.virtual.swimmer.robot import Swimmer

MAX_STEPS_PER_TICK = 200
"""Largest number of steps in a tick, during which fishd answers no request."""


class FreeSwimmer(RobotKind):
    """A fish that swims freely in a two-dimensional fluid."""

    is_tethered = False
    is_real_time = False
    extra = "swimmer"
    packages = frozenset({("swimmer", "numba"), ("lab", "scipy")})
    hides_from_camera = "a swimmer leaves the camera's view"

    @staticmethod
    def check(config: Any) -> None:
        """Refuse a fish, a grid or a step with which the fish cannot be computed."""
        from fishd.virtual.swimmer import feasibility  # imports numpy

        settings, law = config.swimmer, config.plant.servo_law
        if settings.muscle.servo and law != "tanh":
            raise Problem(
                ("plant", "servo_law"),
                f"'{law}' is not possible with swimmer.muscle.servo, which follows tanh",
            )
        feasibility.check(settings)
        if config.estimator.kind == "tail":
            feasibility.check_tail(settings)
        tick, step = config.tick, settings.numerics.step
        steps = max(1, round(tick / step))
        if abs(tick / step - steps) > 1e-6:
            raise Problem(
                ("tick",),
                f"{tick:g} s is not a multiple of swimmer.numerics.step, {step:g} s; "
                f"{steps * step:g} s would be",
            )
        if steps > MAX_STEPS_PER_TICK:
            raise Problem(
                ("swimmer", "numerics", "step"),
                f"{step:g} s makes {steps} steps in a tick, during which fishd answers no request: "
                f"at most {MAX_STEPS_PER_TICK} are possible",
            )

    @staticmethod
    def slow_motion(config: Any) -> float:
        """Return the real time per time of the fish."""
        factor: float = config.swimmer.slow_motion
        return factor

    @staticmethod
    def open(config: Any) -> "Swimmer":
        """Return the fish, at rest and ready to swim; raise `MissingPackage`."""
        try:
            from fishd.virtual.swimmer.robot import Swimmer
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            raise MissingPackage.of_extra("robot: swimmer", package, "swimmer") from None
        fish = Swimmer(
            config.swimmer,
            config.plant,
            config.amplitude_limit,
            config.tick,
            senses_tail=config.estimator.kind == "tail",
        )
        fish.compile()
        return fish

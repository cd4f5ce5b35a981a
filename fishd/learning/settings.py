"""The settings of a training, from a YAML file: every hyper-parameter, with bounds and units."""

import os
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from fishd.controllers.policy.card import COMMAND_FEATURES, MAX_HISTORY_TICKS, FeatureName
from fishd.core import strict_yaml
from fishd.core.camera_frames import StackSettings
from fishd.core.errors import ConfigError
from fishd.core.schema import Problem, convert, drop_empty_sections, note, unit
from fishd.virtual.plant.parameters import PlantParameters

MIN_FRAME_SIZES_PX = {"modes": 16, "cnn": 68, "nature": 36}
"""Smallest frame that all convolutions of the network can process, by feature extractor [px]."""
Share = Annotated[float, Meta(ge=0, le=9)]


BATCH_FEATURES: tuple[FeatureName, ...] = (
    *("fx", "fy", "instruction_angle", "previous_angle", "side_time"),
)
"""Features of an observation that fish of a batch have."""


class EnvironmentSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The observation and the reward of the agent."""

    observation: Annotated[
        tuple[FeatureName, ...],
        note("Inputs of the agent, in order; forces only where `see` permits them."),
    ] = ("fy", "instruction_angle", "previous_angle", "fin_velocity", "side_time")
    readings: Annotated[
        tuple[str, ...],
        note("Readings of sensors that are further inputs, such as water_temperature."),
    ] = ()
    history: Annotated[
        int,
        unit(
            "ticks",
            "Number of latest ticks that the inputs are from, newest first: one tick does not show "
            "the effects of the delay or play of a servo.",
            ge=1,
            le=MAX_HISTORY_TICKS,
        ),
    ] = 1
    force_scale: Annotated[
        Annotated[float, Meta(ge=1e-9, le=1e9)] | None,
        unit("N", "F_y that the network receives as 1; null: K λ ω₀² Φ of the configured plant."),
    ] = None
    thrust_scale: Annotated[
        Annotated[float, Meta(ge=1e-9, le=1e9)] | None,
        unit("N", "F_x whose reward is `reward_scale`; null: the best square wave's thrust."),
    ] = None
    own_fish: Annotated[
        bool,
        note(
            "Where fish are randomised, thrust_scale: null and chatter.dwell: auto are those of "
            "each fish, so that a weak fish counts as much as a strong one."
        ),
    ] = False
    reward_scale: Annotated[float, note("Reward for thrust_scale.", gt=0, le=1000)] = 0.3
    power_price: Annotated[
        float,
        unit(
            "N/W",
            "Smallest thrust that justifies a watt of the servo: the reward is for F_x less this "
            "times the power. A real fish needs a power meter, whose reading is `power`.",
            ge=0,
            le=1000,
        ),
    ] = 0.0
    episode: Annotated[int, unit("ticks", "Steps of an episode.", ge=2)] = 768
    longest_start: Annotated[
        int,
        unit(
            "ticks",
            "Largest number of ticks at a random angle before an episode.",
            ge=0,
            le=1000,
        ),
    ] = 10
    dwell: Annotated[
        bool, note("Whether reversals that ppo would delay (chatter.dwell) are delayed here, too.")
    ] = True
    held_cost: Annotated[
        float,
        note(
            "Share of reward_scale that each tick of such a delay costs, so that policies avoid "
            "it.",
            ge=0,
            le=10,
        ),
    ] = 0.5


class VisionSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The conversion of pictures to numbers, where the agent sees pictures."""

    feature_extractor: Annotated[
        Literal["modes", "cnn", "nature"],
        note(
            "`modes`: patterns that follow the command; `cnn`: a small network for differences of "
            "frames about the axis; `nature`: a large network for unchanged frames, as in the "
            "paper."
        ),
    ] = "modes"
    stack: StackSettings = StackSettings()
    random_excitation: Annotated[
        int,
        unit(
            "ticks",
            "Length of the random motion before learning, which `modes` and `cnn` need.",
            ge=64,
            le=10_000,
        ),
    ] = 256
    align: Annotated[
        bool,
        note(
            "Whether `modes` and `cnn` detect the axis in the random excitation; false: the "
            "middle row."
        ),
    ] = True
    modes: Annotated[
        int, note("Number of patterns of the feature extractor `modes`.", ge=1, le=16)
    ] = 4
    memory: Annotated[
        int, unit("ticks", "Number of commands that `modes` explains a frame by.", ge=2, le=64)
    ] = 8


class Randomisation(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The differences of fish and rig between episodes, which prepare a policy for the real fish.

    A share s multiplies a parameter by (1 + s)^u with u uniform in [-1, 1].
    """

    omega0: Share = 0.0
    xi: Share = 0.0
    servo_speed: Share = 0.0
    coupling: Share = 0.0
    noise: Share = 0.0
    offset: Annotated[
        float, unit("N", "Offset of F_y, uniform in ±offset about the configured one.", ge=0, le=10)
    ] = 0.0
    servo_lag: Share = 0.0
    thrust_coefficient: Share = 0.0
    lateral_drag: Share = 0.0
    servo_delay: Annotated[
        float, unit("s", "Uniform, from the configured value to this much more.", ge=0, le=0.4)
    ] = 0.0
    servo_dead_zone: Annotated[
        float, unit("rad", "Uniform, from the configured value to this much more.", ge=0, le=0.5)
    ] = 0.0
    backlash: Annotated[
        float, unit("rad", "Uniform, from the configured value to this much more.", ge=0, le=0.5)
    ] = 0.0
    servo_reaction: Annotated[
        float, unit("N s^2/rad", "Uniform in ±this about the configured one.", ge=0, le=0.05)
    ] = 0.0
    rotation: Annotated[
        float, unit("rad", "Uniform in ±this about the configured one.", ge=0, le=1.5)
    ] = 0.0
    cable_slack: Annotated[
        float, unit("rad", "Uniform, from the configured value to this much more.", ge=0, le=0.5)
    ] = 0.0
    fish: Annotated[
        tuple[PlantParameters, ...],
        note(
            "Each episode swims one of these, varied as above, instead of the configured fish: "
            "sections `plant`, such as those of the cloud that `fishctl adapt` draws."
        ),
    ] = ()


class ImitationSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The imitation of square waves before PPO begins, in simulation."""

    rounds: Annotated[
        int,
        note(
            "Number of rounds; 0 for none. In each, the policy swims other fish of the "
            "randomisation, more of them like the configured one, and learns when the best square "
            "wave of each would reverse. Only in simulation: that wave of a real fish is unknown.",
            ge=0,
            le=10_000,
        ),
    ] = 0
    fish: Annotated[int, note("Number of fish in a round.", ge=1, le=100_000)] = 500
    clean_rigs: Annotated[
        float,
        note(
            "Fraction of the fish whose rigs have a random fraction of the randomisation of delay, "
            "dead zone, backlash and servo reaction; the other rigs have all of it.",
            ge=0,
            le=1,
        ),
    ] = 0.0
    slow_fish: Annotated[
        float,
        note(
            "Fraction of the fish with both ω₀ and ξ in the lower third of their ranges, where a "
            "wrong beat costs most.",
            ge=0,
            le=1,
        ),
    ] = 0.0
    batched: Annotated[
        bool,
        note(
            "Whether all fish of a round swim at once, hundreds of times as fast. Then the network "
            "learns only from the fish of that round, and the learning rate falls over all rounds. "
            f"The observation may have {', '.join(BATCH_FEATURES)}. Thrust and delay have an error "
            "of a per cent, and F_x has a random offset, too."
        ),
    ] = False
    ticks: Annotated[int, unit("ticks", "Length of the swim of each fish.", ge=8, le=100_000)] = 120
    epochs: Annotated[
        int, note("Passes over the ticks of all previous rounds, after each round.", ge=1, le=1000)
    ] = 12
    batch_size: Annotated[int, note("Size of a minibatch.", ge=2, le=1_000_000)] = 1024
    learning_rate: Annotated[
        float, note("Initial rate; it falls to 0 as a cosine in each round.", gt=0, le=1)
    ] = 3e-3


class PpoSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Hyper-parameters of PPO, with their names in stable-baselines3."""

    n_steps: Annotated[int, note("Number of steps between two updates.", ge=2, le=1_000_000)] = 64
    batch_size: Annotated[int, note("Size of a minibatch.", ge=2, le=1_000_000)] = 64
    n_epochs: Annotated[int, note("Passes over the steps of an update.", ge=1, le=1000)] = 20
    gamma: Annotated[float, note("Discount factor.", ge=0, le=1)] = 0.95
    gae_lambda: Annotated[float, note("Bias against variance of the advantages.", ge=0, le=1)] = (
        0.95
    )
    learning_rate: Annotated[float, note("Rate at the first step.", gt=0, le=1)] = 3e-3
    final_learning_rate: Annotated[
        float, note("Rate from `decay_steps` on; linear until then.", gt=0, le=1)
    ] = 3e-4
    decay_steps: Annotated[int, Meta(ge=1)] = 10_000
    clip_range: Annotated[float, Meta(gt=0, le=1)] = 0.2
    ent_coef: Annotated[float, Meta(ge=0, le=1)] = 0.0
    vf_coef: Annotated[float, Meta(ge=0, le=10)] = 0.5
    max_grad_norm: Annotated[float, Meta(gt=0, le=100)] = 0.5
    target_kl: Annotated[float, Meta(gt=0, le=10)] | None = None
    log_std_init: Annotated[
        float, note("Log of the exploration's deviation, in units of Φ.", ge=-5, le=3)
    ] = 2.5
    clean_rewards: Annotated[
        bool,
        note(
            "Whether to remove the errors of the sensor from F_x: its drifting offset, spikes, and "
            "the share of F_y in F_x of a rotated sensor. Without effect where each episode has "
            "another fish."
        ),
    ] = True
    symmetric: Annotated[
        bool,
        note("Whether the networks are symmetric in left and right; not with pictures and fx."),
    ] = True
    hidden: Annotated[
        tuple[Annotated[int, Meta(ge=1, le=1024)], ...],
        note("Sizes of the hidden layers, for each of policy and value.", min_length=1),
    ] = (64, 64)
    activation: Literal["tanh", "relu"] = "tanh"


class EvaluationSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The deterministic evaluations during training."""

    every: Annotated[
        int,
        note(
            "Number of updates between two evaluations; 0 for none. In simulation the untrained "
            "policy and those of the first 16 updates are evaluated, too.",
            ge=0,
        ),
    ] = 2
    patience: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        unit(
            "evaluations",
            "A training in simulation ends after this number of evaluations in a row that show no "
            "better policy, if the newest is as good as the best and has 97 % of the thrust of the "
            "best square wave; null: it ends after `steps`.",
        ),
    ] = 8
    seconds: Annotated[float, unit("s", "Length of an evaluation.", ge=1, le=3600)] = 20.0
    settle: Annotated[
        float, unit("s", "Time at its beginning that is not evaluated.", ge=0, le=3600)
    ] = 5.0
    on_robot: Annotated[
        float,
        unit(
            "s",
            "Largest length of an evaluation in a tank: policies that may be the best swim for "
            "some seconds each, between rests.",
            ge=8,
            le=3600,
        ),
    ] = 13.0
    others: Annotated[
        int,
        note(
            "Number of other fish of the randomisation in each evaluation, only in simulation; "
            "the best policy is the one that is best on its worst fish.",
            ge=0,
            le=100,
        ),
    ] = 0
    others_from: Annotated[
        Literal["edges", "range"],
        note(
            "Place of these fish in the randomisation. edges: every parameter at one end of its "
            "range, and each swim begins with rapid reversals. range: anywhere in it, as for the "
            "fish of the episodes."
        ),
    ] = "edges"


class TrainingSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A whole training; the defaults suit the default fish."""

    steps: Annotated[
        int,
        note("Largest number of control steps of PPO; 0 for imitation alone.", ge=0),
    ] = 8000
    seed: Annotated[int, note("Seed of networks, exploration and start.", ge=0, le=2**32 - 1)] = 0
    checkpoint_every: Annotated[int, note("Number of steps between checkpoints.", ge=1)] = 5000
    see: Annotated[Literal["force", "camera", "both"], note("Senses of the agent.")] = "force"
    environment: EnvironmentSettings = EnvironmentSettings()
    camera: VisionSettings = VisionSettings()
    randomisation: Randomisation = Randomisation()
    imitation: ImitationSettings = ImitationSettings()
    ppo: PpoSettings = PpoSettings()
    evaluation: EvaluationSettings = EvaluationSettings()

    @property
    def seen(self) -> EnvironmentSettings:
        """Settings of the environment; with `see: camera`, the observation has no forces."""
        names = self.environment.observation
        if self.see == "camera":
            names = tuple(name for name in names if name in COMMAND_FEATURES)
        return replace(self.environment, observation=names)


def load(path: str | os.PathLike[str] | None) -> TrainingSettings:
    """Read the settings of a file, or the defaults; `ConfigError` names file and key."""
    if path is None:
        return TrainingSettings()
    data, sources = strict_yaml.read(path, "a training", "steps: 8000")
    try:
        settings = from_plain(drop_empty_sections(data, TrainingSettings))
        _check(settings)
        return settings
    except Problem as problem:
        raise ConfigError(problem.message_with_place(sources)) from None


def from_plain(data: dict[str, Any]) -> TrainingSettings:
    """Return settings from plain data; raises `Problem`."""
    return convert(data, TrainingSettings)


def check(settings: TrainingSettings) -> None:
    """Raise `ConfigError` for settings that became invalid by changes after loading."""
    try:
        _check(settings)
    except Problem as problem:
        raise ConfigError(problem.message_with_place({})) from None


def to_yaml(settings: TrainingSettings) -> str:
    """Return all settings, defaults included, as YAML that `load` can read."""
    return strict_yaml.dump(msgspec.to_builtins(settings))


def _check(settings: TrainingSettings) -> None:
    """Raise an error for values that are valid one by one but not together."""
    ppo, evaluation = settings.ppo, settings.evaluation
    if not settings.steps and not settings.imitation.rounds:
        raise Problem(
            ("steps",), "0 is not valid without imitation.rounds: there is nothing to learn from"
        )
    if settings.imitation.rounds and settings.see != "force":
        raise Problem(
            ("imitation", "rounds"),
            f"{settings.imitation.rounds} is not valid with see: {settings.see}; imitation is for "
            "policies that see forces only: 0 is needed",
        )
    seen = (*settings.environment.observation, *settings.environment.readings)
    unseen = set(seen) - set(BATCH_FEATURES)
    if settings.imitation.rounds and settings.imitation.batched and unseen:
        raise Problem(
            ("imitation", "batched"),
            f"true is not valid with {', '.join(sorted(unseen))} in environment.observation; only "
            f"{', '.join(BATCH_FEATURES)} are possible",
        )
    if evaluation.others and settings.randomisation == Randomisation():
        raise Problem(
            ("evaluation", "others"),
            f"{evaluation.others} is not valid without a randomisation: they would all be the "
            "configured fish; 0 is needed",
        )
    if ppo.n_steps % ppo.batch_size:
        raise Problem(
            ("ppo", "batch_size"),
            f"{ppo.batch_size} is not valid: n_steps, {ppo.n_steps}, must be a multiple of it",
        )
    if ppo.symmetric and settings.see != "force" and "fx" in settings.seen.observation:
        raise Problem(
            ("ppo", "symmetric"),
            "true is not valid with pictures and fx in environment.observation, which is the same "
            "for a mirrored fish; false is needed",
        )
    for key in ("readings", "observation"):
        seen = getattr(settings.environment, key)
        if len(set(seen)) < len(seen):
            what = f"{list(seen)} is not valid: each may be in it once"
            raise Problem(("environment", key), what)
    if not seen and settings.see == "force":
        raise Problem(
            ("environment", "observation"),
            "an empty list is not valid with see: force; the agent would see nothing",
        )
    extractor, size = settings.camera.feature_extractor, settings.camera.stack.size
    if settings.see != "force" and size < MIN_FRAME_SIZES_PX[extractor]:
        raise Problem(
            ("camera", "stack", "size"),
            f"{size} px is not valid with the feature extractor {extractor}: "
            f"{MIN_FRAME_SIZES_PX[extractor]} px or more are needed",
        )
    needs_excitation = settings.see != "force" and settings.camera.feature_extractor != "nature"
    if needs_excitation and settings.steps <= settings.camera.random_excitation:
        raise Problem(
            ("steps",),
            f"{settings.steps} is not valid: more than the random excitation, "
            f"{settings.camera.random_excitation} steps, is needed",
        )
    if settings.camera.memory >= settings.camera.random_excitation // 4:
        raise Problem(
            ("camera", "memory"),
            f"{settings.camera.memory} ticks is not valid: less than a quarter of "
            f"random_excitation, {settings.camera.random_excitation} ticks, is needed",
        )
    if evaluation.settle >= evaluation.seconds:
        raise Problem(
            ("evaluation", "settle"),
            f"{evaluation.settle:g} s is not valid: less than seconds, {evaluation.seconds:g} s, "
            "is needed",
        )

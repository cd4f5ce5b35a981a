"""Messages of the experiments of the command line to a page: their forms, plans and progress."""

from typing import Literal

from msgspec import Struct

from fishd.core.schema import Field, Scalar

PROGRESS_VARIABLE = "FISHD_PROGRESS"
"""Environment variable; if it is `json`, experiments print their progress as `Progress`."""
PROGRESS_PREFIX = b'{"progress":'
"""Begin of such a line on standard error."""
EXPERIMENT_PREFIX = b"fishctl: experiment "
"""Begin of the line of a queue before each of its experiments."""


class FormField(Field, frozen=True, omit_defaults=True):
    """Description of an option of a verb, as a field of a form."""

    option: str = ""
    """Name on the command line, such as `--for`."""
    on: str = ""
    """Kind of fish that it is for, as in `--on`; empty for both."""
    main: bool = False
    """Whether it is always shown, not only among the further options."""
    initial: Scalar = None
    """Value that a form begins with, if that is not the default."""


class Form(Struct, frozen=True, omit_defaults=True):
    """Description of a verb, as a form of a page."""

    kind: str
    title: str
    words: list[str]
    """Words of the verb, such as `learn ppo`."""
    about: str
    """Help in one line."""
    argument: Literal["", "controller", "contestants", "recordings", "run", "name"] = ""
    """Kind of its arguments."""
    without_argument: list[str] = []
    """Options that it needs if no argument is given."""
    values: Literal["", "one", "several", "range"] = ""
    """Number of values that a parameter of the controller takes."""
    fields: list[FormField] = []
    is_experiment: bool = False
    """Whether it takes `--on`, and swims the live fish unless that is `simulation`."""
    has_plan: bool = False
    """Whether it takes `--dry-run`."""
    problem: str = ""
    """Reason why it cannot be started on this machine; empty if it can."""


class Plan(Struct, frozen=True):
    """Amount of work of an experiment with which nothing is wrong."""

    amount: float
    unit: str
    """Unit of `amount`, such as `s` or `points`."""
    seconds: float | None = None
    """Expected duration [s]; null where it is unknown."""


class Estimate(Struct, frozen=True, omit_defaults=True):
    """A number with its 95 % interval."""

    name: str
    value: float
    low: float | None = None
    high: float | None = None
    unit: str = "1"


class CurvePoint(Struct, frozen=True, omit_defaults=True):
    """A point of the curve that grows with an experiment."""

    x: float
    y: float
    ci95: float | None = None
    """Half-width of the 95 % interval of `y`."""
    x_name: str = ""
    y_name: str = "thrust"
    unit: str = "N"
    """Unit of `y`."""
    series: str = ""
    """Name of the curve, where there are several."""


class Progress(Struct, frozen=True, omit_defaults=True):
    """State of an experiment that runs."""

    fraction: float
    """Share that is done."""
    remaining: float | None = None
    """Expected time until the end [s]; null while it is unknown."""
    doing: str = ""
    """Present step, in words."""
    estimates: list[Estimate] | None = None
    """Best values until now; null if they have not changed."""
    point: CurvePoint | None = None
    """New point of the curve."""

"""Command line that all experiments share: choice of the fish, folder, and how one ends."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import click
from msgspec import to_builtins
from msgspec.structs import replace

from fishd.cli.config import config_option, set_option
from fishd.cli.controller_arguments import ControllerGroup
from fishd.cli.options import F, endpoint_option, take_option, verb_lease
from fishd.cli.output import echo
from fishd.config import Config, Start, load
from fishd.core.addresses import ENDPOINT_VARIABLE, find_control_address, socket_path
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError, NoDaemon
from fishd.core.process import unix_sockets
from fishd.core.process.interruption import raise_on_first_signal

if TYPE_CHECKING:
    from fishd.lab.experiment import Experiment, Header
    from fishd.lab.session import Session

On = Literal["live", "simulation"]
RUN_ONLY_OPTIONS = {
    "--folder": 1, "--resume": 1, "--plot": 1, "--json": 0, "--take": 0, "--on": 1, "--endpoint": 1,
    "--cluster": 1,
}  # fmt: skip
"""Options that are not kept as they are given, and the number of words after each.

The header of an experiment has the fish that `--on` and `--endpoint` stand for."""
_COMMAND = "fishd.words"
"""Key of the command line in click's context, for the header of an experiment."""


class ChosenFish(NamedTuple):
    """The fish that an experiment is about."""

    on: On
    file: Path | None
    """Configuration of a simulated fish; None for the defaults."""
    overrides: tuple[str, ...]
    endpoint: str | None

    def __str__(self) -> str:
        """Return which fish it is, in words."""
        if self.on == "live":
            return f"the fish of fishd at {self.endpoint or find_control_address()}"
        fish = f"the simulated fish of {self.file}" if self.file else "the default simulated fish"
        return f"{fish}, changed by --set" if self.overrides else fish

    def load(self, overrides: Sequence[str] = ()) -> Config:
        """Return the configuration of a simulated fish at rest; raises `ConfigError`."""
        return replace(load(self.file, (*self.overrides, *overrides)), start=Start())

    @contextmanager
    def session(self, **piloted: Any) -> "Iterator[Session]":
        """Open a session, which is not entered yet: nothing moves, and no lease is taken.

        piloted: camera and agent of policies that see pictures, as for `PilotedSession`
        """
        from fishd.lab.session import LiveSession, VirtualSession

        if self.on == "simulation":
            yield VirtualSession(self.load())
            return
        from fishd.client import Fish

        with Fish(self.endpoint) as fish:
            if piloted:
                from fishd.lab.compare.piloted_session import PilotedSession

                yield PilotedSession(fish, *verb_lease(), **piloted)
            else:
                yield LiveSession(fish, *verb_lease())

    def announce(self, as_json: bool = False) -> None:
        """Print which fish it is: the first line of an experiment."""
        echo(f"fish: {self}", err=as_json)

    def refuse_other(
        self, simulation_options: dict[str, Any], live_options: dict[str, Any]
    ) -> None:
        """Raise `UsageError` for an option that only applies to the other kind of fish."""
        live = self.on == "live"
        for name, value in (simulation_options if live else live_options).items():
            if value not in (None, (), False):
                raise click.UsageError(f"{name} is for --on {'simulation' if live else 'live'}")


class ExperimentFolder(NamedTuple):
    """The folder of an experiment, new or to be resumed."""

    kind: str
    """Verb of the experiment, such as `sweep`."""
    path: Path
    resume: bool
    command: tuple[str, ...]
    """Arguments of the verb that a resumed experiment takes over."""
    is_named: bool
    """Whether the folder is on the command line."""

    @contextmanager
    def open(
        self,
        fish: ChosenFish,
        settings: dict[str, Any],
        session: "Session | None",
        *,
        begins_again: bool = False,
    ) -> "Iterator[Experiment]":
        """Begin or resume the experiment; raises `ConfigError`.

        settings: what else the rows depend on, besides the fish
        session: not entered yet; None for fish that swim without one
        begins_again: whether a resumed simulation keeps nothing that was measured before; else it
            continues with other noise
        """
        from fishd.lab.experiment import Header, count_attempts, open_experiment
        from fishd.lab.session import VirtualSession

        endpoint_words = ("--endpoint", fish.endpoint) if fish.endpoint else ()
        header = Header(
            kind=self.kind,
            on=fish.on,
            config=session.config if session else to_builtins(fish.load()),
            settings=settings,
            force_unit=session.unit if session else "N",
            command=[*self.command, "--on", fish.on, *endpoint_words],
        )
        with open_experiment(self.path, header, resume=self.resume) as experiment:
            if isinstance(session, VirtualSession) and not begins_again:
                session.resume(count_attempts(self.path))
            yield experiment


def fish_choice(function: F) -> F:
    """Add `--on`, `--config`, `--set`, `--endpoint` and `--take`, passed as `fish`."""
    return _fish_choice(function, live_config=False)


def fish_choice_and_config(function: F) -> F:
    """Add the same options to a verb that uses `--config` with a live fish, too."""
    return _fish_choice(function, live_config=True)


def _fish_choice(function: F, *, live_config: bool) -> F:
    @wraps(function)
    def wrapper(
        *args: Any,
        on: On | None,
        file: Path | None,
        overrides: tuple[str, ...],
        endpoint: str | None,
        **values: Any,
    ) -> Any:
        place: ExperimentFolder | None = values.get("place")
        if on is None and place and place.resume:
            on = _read_header(place.path).on
        on = on or default_on(file, overrides, endpoint)
        if on == "live" and (file or overrides) and not live_config:
            name = "--config" if file else "--set"
            raise click.UsageError(f"{name} is for --on simulation: fishd keeps its configuration")
        return function(*args, fish=ChosenFish(on, file, overrides, endpoint), **values)

    scope = "" if live_config else "In simulation: "
    for option in (
        take_option,
        endpoint_option,
        set_option,
        config_option(f"{scope}YAML file of the fish, as for fishd. [default: the defaults]"),
        on_option,
    ):
        wrapper = option(wrapper)
    return wrapper  # type: ignore[return-value]


on_option = click.option(
    "--on",
    type=click.Choice(["live", "simulation"]),
    help="live: the fish of the running fishd, real or simulated; simulation: a fish in virtual "
    "time. [default: live if a fishd runs and neither --config nor --set is given]",
)


def default_on(file: Path | None, overrides: tuple[str, ...], endpoint: str | None) -> On:
    """Return the kind of fish for a command line without `--on`."""
    if file or overrides:
        return "simulation"
    return "live" if endpoint or is_fishd_running() else "simulation"


def is_fishd_running() -> bool:
    """Return whether a client would reach a fishd by default; $FISHD_ENDPOINT counts as one."""
    path = socket_path(find_control_address())
    return bool(os.environ.get(ENDPOINT_VARIABLE)) or bool(
        path and path.exists() and not unix_sockets.is_deserted(path)
    )


def folder_options(function: F) -> F:
    """Add `--folder` and `--resume`, passed as `place`."""
    return _folder_options(function, "")


def live_folder_options(function: F) -> F:
    """Add the same options to a verb that uses `keep_experiment`."""
    return _folder_options(function, "; in simulation none: nothing is kept")


def _folder_options(function: F, otherwise: str) -> F:
    @wraps(function)
    def wrapper(*args: Any, folder: Path | None, resume: Path | None, **values: Any) -> Any:
        if folder and resume:
            raise click.UsageError("--folder is for a new experiment, --resume for one: give one")
        from fishd.lab.experiment import default_folder

        context = click.get_current_context()
        place = ExperimentFolder(
            kind=verb_words(context),
            path=resume or folder or default_folder(verb_words(context)),
            resume=resume is not None,
            command=kept_arguments(context),
            is_named=bool(resume or folder),
        )
        return function(*args, place=place, **values)

    for option in (
        click.option(
            "--resume",
            type=click.Path(path_type=Path),
            metavar="FOLDER",
            help="Resume the experiment in this folder, with its options; nothing is measured "
            "again.",
        ),
        click.option(
            "--folder",
            type=click.Path(path_type=Path),
            help="New folder of the experiment. [default: VERB-DATE-TIME in $FISHD_RUNS, else "
            f"runs{otherwise}]",
        ),
    ):
        wrapper = option(wrapper)
    return wrapper  # type: ignore[return-value]


@contextmanager
def keep_experiment(
    place: ExperimentFolder,
    fish: ChosenFish,
    session: "Session | None",
    settings: dict[str, Any],
) -> "Iterator[Experiment | None]":
    """Open the folder of an experiment; yield None in simulation without `--folder`.

    A resumed simulation begins again: virtual time costs nothing, and the result is that of one
    that was not interrupted.

    session: None for fish that swim without one
    settings: what the result depends on, besides the fish
    """
    if fish.on == "simulation" and not place.is_named:
        yield None
        return
    with place.open(fish, settings, session, begins_again=True) as experiment:
        yield experiment


@contextmanager
def record_session(
    experiment: "Experiment | None", session: "Session", *, logged: bool = True
) -> Iterator[None]:
    """Record a session into the folder of its experiment, if there is one.

    logged: whether a live session logs its swims and rests, so that a resumed one repeats none
    """
    if experiment is None:
        yield
        return
    kind = experiment.header.kind
    with session.recorded(experiment.recording(kind), f"fishctl {kind}") as writer:
        if logged and experiment.header.on == "live":
            from fishd.lab.swim_log import SwimLog

            session.swim_logged = SwimLog(experiment, writer, session.tick).swim
        yield


def verb_words(context: click.Context) -> str:
    """Return the words of a verb without a controller: `sweep`, `learn ppo`."""
    words = context.command_path.split()[1:]
    return " ".join(words[: 2 if words[0] in ("learn",) else 1])


def _read_header(folder: Path) -> "Header":
    from fishd.lab.experiment import read_header

    return read_header(folder)


def _read_command(context: click.Context, folder: Path) -> list[str]:
    """Return the arguments of the experiment in a folder."""
    header = _read_header(folder)
    if header.kind != verb_words(context):
        raise click.UsageError(
            f"--resume {folder}: it is of another verb: fishctl {header.kind} --resume {folder}"
        )
    return header.command


def restore_arguments(
    context: click.Context,
    args: list[str],
    read_command: Callable[[click.Context, Path], list[str]] = _read_command,
    run_only: Mapping[str, int] = RUN_ONLY_OPTIONS,
) -> list[str]:
    """Return the arguments of a verb, after those of what `--resume` names.

    The arguments are kept for a later `--resume`: see `kept_arguments`.

    read_command: returns the arguments that are kept in a folder or file
    run_only: options that are not kept, and the number of words after each
    """
    path = next((b for a, b in pairwise(args) if a == "--resume"), None)
    path = path or next((a[9:] for a in args if a.startswith("--resume=")), None)
    if path is not None and args[0].startswith("-"):
        args = [*read_command(context, Path(path)), *args]
    context.meta[_COMMAND] = list(_without_options(args, run_only))
    return args


def kept_arguments(context: click.Context) -> tuple[str, ...]:
    """Return the arguments that a resumed experiment or swim takes over."""
    return tuple(context.meta.get(_COMMAND, ()))


def _without_options(args: Sequence[str], run_only: Mapping[str, int]) -> Iterator[str]:
    words = iter(args)
    for word in words:
        name, equals, _ = word.partition("=")
        if name not in run_only:
            yield word
        elif run_only[name] and not equals:
            next(words, None)


class Resumable(click.Command):
    """Verb for which `--resume` restores the options of the resumed experiment."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments after those of the resumed experiment."""
        return super().parse_args(ctx, restore_arguments(ctx, args))


class ResumableGroup(Resumable, ControllerGroup):
    """The same, for a verb whose sub-commands are the controllers."""


class ExperimentEnding:
    """State of the end of an experiment: whether it was interrupted, and how to resume it."""

    def __init__(self, experiment: "Experiment | None", cluster: str | None = None) -> None:
        """experiment: None where nothing is kept; cluster: address of the cluster it uses"""
        self.hint = f"resume with: {experiment.resume_command}" if experiment else "nothing is kept"
        """How the experiment is resumed, for a message."""
        if cluster:
            self.hint += "; add --cluster ADDRESS to use a cluster again"
        self._experiment = experiment
        self._is_interrupted = False

    @property
    def is_interrupted(self) -> bool:
        """Whether the experiment ends before it is complete."""
        return self._is_interrupted

    @is_interrupted.setter
    def is_interrupted(self, value: bool) -> None:
        self._is_interrupted = value
        if self._experiment:
            self._experiment.is_interrupted = value

    @contextmanager
    def measuring(self, *errors: type[FishdError]) -> Iterator[None]:
        """Let the first signal end this, with the fish at rest, and keep what was measured.

        An error of these types, by default those for a lost fish, is raised with the command
        that resumes the experiment.
        """
        from fishd.lab.session import Disturbed

        try:
            with raise_on_first_signal():
                yield
        except KeyboardInterrupt:
            self.is_interrupted = True
        except FishdError as error:
            if not isinstance(error, errors or (Disturbed, NoDaemon)):
                raise
            error.args = (f"{error}; {self.hint}",)
            raise

    def interrupted(self, done: str) -> int:
        """Print how an interrupted experiment is resumed; return the exit status.

        done: what was finished, in words
        """
        echo(f"fishctl: interrupted, {done}; {self.hint}", err=True)
        return INTERRUPTED

"""The runner of experiments: choice of the fish, folder, display, signals and exit status.

A verb takes its options besides those of `experiment_options`, and a `Run`. It swims the fish of
`Run.session` within `Run.swimming`, and shows its result with `Run.show`. A resumed verb does the
same again: of a live fish the session has the finished swims in its log, and a simulated fish swims
them again, with the same noise.
"""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import wraps
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, Self

import click
from msgspec import to_builtins
from msgspec.structs import replace

from fishd.cli.config import config_option, set_option
from fishd.cli.controller_arguments import ControllerGroup
from fishd.cli.experiment_options import (
    FishOption,
    On,
    default_on,
    dry_run_option,
    end_dry_run,
    kept_arguments,
    on_option,
    refuse_other_fish,
    restore_arguments,
)
from fishd.cli.options import (
    F,
    endpoint_option,
    json_option,
    plot_option,
    tail_option,
    take_option,
    verb_lease,
)
from fishd.cli.output import echo, print_json
from fishd.cli.progress import Lines, report_progress, show_progress
from fishd.config import Config, Start, load
from fishd.core.addresses import find_control_address
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError
from fishd.core.experiments import Estimate, Plan, Progress
from fishd.core.process.interruption import raise_on_first_signal
from fishd.core.signals import Event, Tick

if TYPE_CHECKING:
    from fishd.lab.experiment import Experiment
    from fishd.lab.session import Session

LIVE: dict[str, Any] = {"cls": FishOption, "on": "live"}
"""Settings of an option that only applies to a live fish."""
SIMULATED: dict[str, Any] = {"cls": FishOption, "on": "simulation"}
"""Settings of an option that only applies to a simulated fish."""
MEASURED_TAIL = "measure the largest fin angle, too."
"""Help of `--tail` of a verb that measures thrust."""


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


class Ending:
    """The end of an experiment by a signal or an error, and the command that resumes it."""

    def __init__(self, experiment: "Experiment | None" = None, cluster: str | None = None) -> None:
        """experiment: None where nothing is kept; cluster: address of the cluster it uses"""
        self.hint = f"resume with: {experiment.resume_command}" if experiment else "nothing is kept"
        """How the experiment is resumed, for a message."""
        if cluster:
            self.hint += "; add --cluster ADDRESS to use a cluster again"
        self.is_interrupted = False
        """Whether a signal has ended the measurement."""

    @contextmanager
    def measuring(self) -> Iterator[None]:
        """Let the first signal end this, with the fish at rest, and keep what was measured.

        An error that more measuring may avoid is raised with the command that resumes it.
        """
        from fishd.lab.session import Replaced, concerns_one_controller

        try:
            with raise_on_first_signal():
                yield
        except KeyboardInterrupt:
            self.is_interrupted = True
        except FishdError as error:
            if isinstance(error, Replaced) or not concerns_one_controller(error):
                error.args = (f"{error}; {self.hint}",)
            raise

    def check(self, done: str) -> None:
        """Print how an interrupted experiment is resumed, and end the verb.

        done: what was finished, in words
        """
        if self.is_interrupted:
            self.end_verb(f"interrupted, {done}; {self.hint}", INTERRUPTED)

    def end_verb(self, message: str, status: int) -> NoReturn:
        """Print a message and end the verb before its experiment is complete."""
        echo(f"fishctl: {message}", err=True)
        raise click.exceptions.Exit(status)


class _Bar:
    """A listener of a session that moves a bar with the tank time."""

    def __init__(self, session: "Session", show: Lines, since: float) -> None:
        """since: time that was used before this session [s]"""
        self._session, self._show, self._since = session, show, since

    def tick(self, _: Tick) -> None:
        self._show.at(self._since + self._session.used)

    def event(self, _: Event) -> None:
        pass


class Run:
    """One run of the verb of this command line; a context manager."""

    def __init__(
        self,
        fish: ChosenFish,
        folder: Path | None,
        resume: Path | None,
        picture: Path | None,
        *,
        as_json: bool,
        keeps_simulations: bool,
        uses_tail: bool = False,
        is_dry: bool = False,
    ) -> None:
        """Raises `UsageError`, and `FishdError` for a picture that cannot be drawn.

        is_dry: whether the verb ends before the fish swims
        """
        from fishd.lab import drawing
        from fishd.lab.experiment import default_folder

        if folder and resume:
            raise click.UsageError("--folder is for a new experiment, --resume for one: give one")
        if is_dry and resume:
            raise click.UsageError("--dry-run is for a new experiment")
        if keeps_simulations:
            drawing.check_installed()
        if picture:
            drawing.check(picture)
        context = click.get_current_context()
        self.fish, self.picture, self.as_json = fish, picture, as_json
        self.kind = verb_words(context)
        self.folder = resume or folder or default_folder(self.kind)
        self.is_resumed = resume is not None
        self.has_folder = bool(resume or folder)
        """Whether the folder is on the command line."""
        self.ending = Ending()
        self.uses_tail = uses_tail
        """Whether the fin angles of a camera are used."""
        self._keeps = keeps_simulations or fish.on == "live" or self.has_folder
        self._command = kept_arguments(context)
        self._is_dry = is_dry
        self._stack = ExitStack()
        if is_dry:
            self.folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory())) / "dry"
        self._session: Session | None = None
        self._has_begun = False
        """Whether it has printed which fish it is about."""
        self._experiment: Experiment | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: Any) -> None:
        self._stack.__exit__(*exception)
        if isinstance(exception[1], KeyboardInterrupt):  # after the fish was left at rest
            self.ending.end_verb(f"interrupted; {self.ending.hint}", INTERRUPTED)

    def session(self, **piloted: Any) -> "Session":
        """Return the session with the fish: nothing moves before `swimming`.

        piloted: camera and agent of policies that see pictures, as for `PilotedSession`
        """
        if self._session is None:
            self._session = self._open_session(**piloted)
        return self._session

    def _open_session(self, **piloted: Any) -> "Session":
        session = self._open_fish(**piloted)
        if self.uses_tail and self.fish.on == "live":
            from fishd.camera.tap import CameraTap
            from fishd.lab.fin_angle import FinAngles

            camera = self._stack.enter_context(CameraTap(None, self.fish.endpoint))
            camera.refuse_unmeasured()
            session.fin_angles = FinAngles(camera, lambda line: echo(f"fishctl: {line}", err=True))
        return session

    def _open_fish(self, **piloted: Any) -> "Session":
        from fishd.lab.session import LiveSession, VirtualSession

        if self.fish.on == "simulation":
            return VirtualSession(self.fish.load())
        from fishd.client import Fish

        fish = self._stack.enter_context(Fish(self.fish.endpoint))
        name, takes = verb_lease()
        lease = name, takes or self._is_dry  # which takes nothing, but is not refused either
        if not piloted:
            return LiveSession(fish, *lease)
        from fishd.lab.compare.piloted_session import PilotedSession

        return PilotedSession(fish, *lease, **piloted)

    @property
    def experiment(self) -> "Experiment":
        """Folder of the experiment, after `open` of a verb that keeps simulations, too."""
        assert self._experiment
        return self._experiment

    def open(self, settings: dict[str, Any], cluster: str | None = None) -> None:
        """Begin or resume the experiment in its folder.

        In simulation nothing is kept, unless the verb keeps it or `--folder` is given.

        settings: what the results depend on, besides the fish
        cluster: address of the cluster that swims the fish
        Raises `ConfigError`.
        """
        from fishd.lab.experiment import Header, open_experiment

        if self._keeps:
            session, endpoint = self._session, self.fish.endpoint
            header = Header(
                kind=self.kind,
                on=self.fish.on,
                config=session.config if session else to_builtins(self.fish.load()),
                settings=settings,
                force_unit=session.unit if session else "N",
                command=[
                    *self._command,
                    *("--on", self.fish.on),
                    *(("--endpoint", endpoint) if endpoint else ()),
                ],
            )
            self._experiment = self._stack.enter_context(
                open_experiment(self.folder, header, resume=self.is_resumed)
            )
            self.ending = Ending(self._experiment, cluster)

    def echo(self, line: str = "") -> None:
        """Print a line, and before the first one which fish it is about.

        If the output is JSON, it is on standard error. A dry run prints none.
        """
        if self._is_dry:
            return
        if not self._has_begun:
            self._has_begun = True
            echo(f"fish: {self.fish}", err=self.as_json)
        if line:
            echo(line, err=self.as_json)

    @contextmanager
    def swimming(
        self,
        total: float,
        unit: str = "s",
        *,
        since: float = 0.0,
        recorded: bool = True,
        logged: bool = True,
    ) -> Iterator[Lines]:
        """Take the fish, and leave it at rest; record what it swims; yield the display.

        A signal ends this early: see `check`. Swims of a live fish are logged, so that none is
        repeated by a resumed verb that requests the same swims.

        total: total amount for the bar [`unit`]; since: part of it that was swum before
        recorded: False for a verb that records its parts itself, and is resumed part by part
        logged: False for a verb that resumes an interrupted swim, not only the following ones
        """
        from fishd.lab.swim_log import SwimLog
        from fishd.recording.folder import list_recordings

        is_time = self.fish.on == "live" and unit.startswith("s")
        self.end_dry_run(total, unit, total if is_time else None)
        self.echo()
        session, experiment, began = self._session, self._experiment, False
        with self.ending.measuring(), ExitStack() as stack:
            if session:
                stack.enter_context(session)
            if session and session.fin_angles:
                if self.is_resumed:
                    session.fin_angles.read(list_recordings(self.folder))
                stack.enter_context(session.heard_by(session.fin_angles))
            if session and experiment and recorded:
                path, note = experiment.recording(self.kind), f"fishctl {self.kind}"
                writer = stack.enter_context(session.recorded(path, note))
                if logged and self.fish.on == "live":
                    log = SwimLog(experiment, writer, session.tick)
                    stack.enter_context(session.logged(log.swim))
            show = stack.enter_context(show_progress(total, unit, err=self.as_json))
            if session:
                stack.enter_context(session.heard_by(_Bar(session, show, since)))
            began = True
            yield show
        if not began:
            self.check("before anything was measured")

    def end_dry_run(self, total: float, unit: str, seconds: float | None = None) -> None:
        """End the verb if it is a dry run; seconds: duration of `total` [s], None if unknown."""
        if self._is_dry:
            end_dry_run(Plan(total, unit, seconds), self.as_json)

    def check(self, done: str = "the fish rests") -> None:
        """End the verb if a signal has ended the measurement; done: what was finished, in words."""
        self.ending.check(done)

    def show(
        self,
        result: Any,
        print_result: Callable[[], None],
        *,
        kept: Any = None,
        estimates: Sequence[Estimate] = (),
        headline: str = "",
    ) -> None:
        """Write a result into the folder, and print it, as JSON or by `print_result`.

        kept: what is written, if that is more than what is printed as JSON
        estimates, headline: the result in short, for a page
        """
        if estimates or headline:
            report_progress(Progress(1.0, 0.0, headline, list(estimates)))
        if self._experiment:
            self._experiment.write_result(result if kept is None else kept)
        if self.as_json:
            print_json(result)
        else:
            print_result()

    def echo_folder(self) -> None:
        """Print the folder of the experiment, if there is one."""
        if self._experiment:
            echo(f"folder: {self.folder}")

    @property
    def kept_picture(self) -> Path | None:
        """File of the picture: the given one, else one in the folder if the experiment has one."""
        if self.picture or not self._experiment or find_spec("matplotlib") is None:
            return self.picture
        return self.folder / f"{self.kind}.png"

    def pictures(self, stem: str) -> list[Path]:
        """Return the files of the picture: the given one, else two in the folder."""
        if self.picture:
            return [self.picture]
        return [self.folder / f"{stem}.png", self.folder / f"{stem}.svg"]

    def echo_pictures(self, paths: Sequence[Path]) -> None:
        """Print the files of the picture, unless the output is JSON."""
        if not self.as_json:
            echo(f"picture: {', '.join(map(str, paths))}")


def experiment_options(
    *others: Callable[[Any], Any],
    plot: str | None = None,
    tail: str = "",
    keeps_simulations: bool = False,
    live_config: bool = False,
) -> Callable[[F], F]:
    """Return a decorator that adds the options of each experiment, passed as `run`, and others.

    others: options of the verb itself, in the order of its help
    plot: what its picture shows; None for a verb without one, which has no `--plot`
    tail: what `--tail` does; empty for a verb without it
    keeps_simulations: whether a simulation has a folder by default, with a picture
    live_config: whether `--config` and `--set` apply to a live fish, too
    """

    def decorate(function: F) -> F:
        @wraps(function)
        def wrapper(
            *args: Any,
            on: On | None,
            file: Path | None,
            overrides: tuple[str, ...],
            endpoint: str | None,
            folder: Path | None,
            resume: Path | None,
            as_json: bool,
            picture: Path | None = None,
            uses_tail: bool = False,
            is_dry: bool = False,
            **values: Any,
        ) -> Any:
            if on is None and resume:
                on = _read_on(resume)
            on = on or default_on(file, overrides, endpoint)
            refuse_other_fish(click.get_current_context(), on)
            if on == "live" and (file or overrides) and not live_config:
                name = "--config" if file else "--set"
                raise click.UsageError(
                    f"{name} is for --on simulation: fishd keeps its configuration"
                )
            fish = ChosenFish(on, file, overrides, endpoint)
            with Run(
                fish,
                folder,
                resume,
                picture,
                as_json=as_json,
                keeps_simulations=keeps_simulations,
                uses_tail=uses_tail,
                is_dry=is_dry,
            ) as run:
                return function(*args, run=run, **values)

        scope = "" if live_config else "In simulation: "
        otherwise = "" if keeps_simulations else "; in simulation none: nothing is kept"
        config = f"{scope}YAML file of the fish, as for fishd. [default: the defaults]"
        for option in (
            json_option,
            *([plot_option(plot)] if plot else []),
            *([tail_option(tail, **({} if live_config else LIVE))] if tail else []),
            dry_run_option,
            take_option,
            endpoint_option,
            set_option,
            config_option(config),
            on_option,
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
            *reversed(others),
        ):
            wrapper = option(wrapper)
        return wrapper  # type: ignore[return-value]

    return decorate


def verb_words(context: click.Context) -> str:
    """Return the words of a verb without a controller: `sweep`, `learn ppo`."""
    words = context.command_path.split()[1:]
    return " ".join(words[: 2 if words[0] in ("learn",) else 1])


def _read_on(folder: Path) -> On:
    from fishd.lab.experiment import read_header

    return read_header(folder).on


class Resumable(click.Command):
    """Verb for which `--resume` restores the options of the resumed experiment."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments after those of the resumed experiment."""
        return super().parse_args(ctx, restore_arguments(ctx, args, _read_command))


class ResumableGroup(Resumable, ControllerGroup):
    """The same, for a verb whose sub-commands are the controllers."""


def _read_command(context: click.Context, folder: Path) -> list[str]:
    """Return the arguments of the experiment in a folder."""
    from fishd.lab.experiment import read_header

    header = read_header(folder)
    if header.kind != verb_words(context):
        raise click.UsageError(
            f"--resume {folder}: it is of another verb: fishctl {header.kind} --resume {folder}"
        )
    return header.command

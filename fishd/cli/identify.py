"""The verb `fishctl identify`, which identifies a fish from its forces."""

import json
import os
import shlex
import subprocess
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from copy import deepcopy
from datetime import datetime
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec.structs import asdict

from fishd.cli.experiment import Resumable, Run, experiment_options
from fishd.cli.options import FiniteRange, NamesType, for_option
from fishd.cli.output import echo
from fishd.cli.progress import Bar, Lines, Reports, show_waiting
from fishd.cli.recording.files import open_recording
from fishd.config import Config, ServoSettings, adopt, check_tethered, load
from fishd.core import files
from fishd.core.errors import FishdError
from fishd.core.experiments import CurvePoint, Estimate
from fishd.core.process.fishctl_child import fishctl_command
from fishd.core.signals import Event, Tick
from fishd.recording.folder import list_recordings
from fishd.recording.reader import open_run

if TYPE_CHECKING:
    from fishd.lab.identification import Identification

DEFAULT_EXPERIMENT_S = 180.0
FIRST_FIT_S = 20.0
"""Length of the experiment at its first fit while the fish swims [s]."""
FIT_GROWTH = 1.5
"""Ratio of the lengths of the experiment at two fits: an interval shrinks by about a fifth."""
SHOWN = (
    *("omega0", "xi", "servo_speed", "coupling", "thrust_coefficient"),
    "thrust_coefficient * coupling^2",
)
"""Constants that are shown while the fish swims, if the forces determine them."""


@click.command(cls=Resumable)
@click.argument("runs", nargs=-1, metavar="[RUN]...")
@experiment_options(
    click.option(
        "--experiment", is_flag=True, help="First swim an experiment for the identification."
    ),
    for_option(
        f"Duration of the experiment [s]. [default: {DEFAULT_EXPERIMENT_S:g}]",
        kind=FiniteRange(min=30.0, max=3600.0),
    ),
    click.option(
        "--fit",
        type=NamesType(),
        metavar="NAME,...",
        help="Parameters to fit; the others keep their configured values. [default: omega0, xi, "
        "quadratic_drag, coupling, servo_speed, servo_lag, thrust_coefficient, "
        "lateral_inertia_ratio, lateral_drag, servo_delay, backlash, rotation; and if the forces "
        "show them lateral_quadratic_drag, cable_slack, servo_dead_zone, servo_reaction]",
    ),
    click.option(
        "--fix",
        type=NamesType(),
        default=(),
        metavar="NAME,...",
        help="Known parameters, which are not fitted: lateral_inertia_ratio if K_y = K, or "
        "coupling if λ was measured.",
    ),
    click.option(
        "--to",
        "target",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE",
        help="Write the sections plant and simulation of a configuration into this file.",
    ),
    click.option("--force", is_flag=True, help="Overwrite FILE."),
    click.option(
        "--tail-scale",
        type=FiniteRange(min=0.0, max=0.5),
        metavar="FRACTION",
        default=0.01,
        show_default=True,
        help="Half-width of the 95 % interval of the scale of fin angles.",
    ),
    tail="Use fin angles that a camera measures, for K, λ, K_y and K_d each for itself.",
    plot="forces, fit and residual",
    live_config=True,
)
def identify(
    runs: tuple[str, ...],
    experiment: bool,
    seconds: float | None,
    fit: tuple[str, ...] | None,
    fix: tuple[str, ...],
    target: Path | None,
    force: bool,
    tail_scale: float,
    run: Run,
) -> None:
    """Identify a fish and its rig from F_x, F_y and φ_c, with 95 % intervals.

    RUN is a path, a name in the folder of recordings, or 'latest'. Several recordings are fitted
    together, as one fish. --experiment swims and fits a new one instead. The fit starts from the
    configuration of --config.

    --to writes a file for `fishd --config` and `fishctl simulate --config`.
    """
    if experiment == bool(runs):
        raise click.UsageError("name recordings to identify, or use --experiment: one of the two")
    for option, is_given in (("--for", seconds is not None), ("--folder", run.has_folder)):
        if is_given and not experiment:
            raise click.UsageError(f"{option} goes with --experiment")
    if experiment and run.uses_tail and run.fish.on == "simulation":
        raise click.UsageError("--tail is for --on live")
    if target and target.exists() and not force:
        raise FishdError(f"{target}: exists already; --force overwrites it, --to names another")

    from fishd.lab import identification as lab

    lab.check(lab.DEFAULT if fit is None else fit, fix)  # before minutes of swimming
    if experiment:
        options = [f"--fix={','.join(fix)}"] if fix else []
        options += [f"--fit={','.join(fit)}"] if fit else []
        options += ["--tail", f"--tail-scale={tail_scale}"] if run.uses_tail else []
        config, tables, servo = _swim_experiment(run, seconds or DEFAULT_EXPERIMENT_S, options)
        origin = f"an experiment with {run.fish}"
    else:
        config, servo = load(run.fish.file, run.fish.overrides), None
        check_tethered(config.robot, "identify")
        tables = [open_recording(name, None) for name in runs]
        run.end_dry_run(len(tables), "recordings")
        origin = ", ".join(table.path.name for table in tables)
    with show_waiting("fitting the model to the forces"):
        identification = lab.identify(
            tables,
            start=config.plant,
            rig=config.simulation,
            fit=fit,
            fix=fix,
            servo=servo,
            tail_scale=tail_scale if run.uses_tail else None,
        )
    result = identification.to_builtins() | {"origin": origin}
    run.show(
        result,
        lambda: _print_result(identification, origin),
        kept=result | {"summary": identification.summary},
        estimates=[
            Estimate(e.name, e.value, e.ci95_low, e.ci95_high, e.unit)
            for e in identification.estimates
            if e.fitted and isfinite(e.ci95_low) and isfinite(e.ci95_high)
        ],
        headline=identification.headline,
    )
    for remark in identification.remarks:
        echo(f"fishctl: careful: {remark}", err=True)
    if target:
        content = identification.to_yaml(f"{origin} on {datetime.now():%Y-%m-%d}")
        with files.os_errors(FishdError, f"{target}: cannot be written"):
            files.write_atomically(target, content)
        command = f"fishctl simulate swing --config {shlex.quote(str(target))}"
        echo(f"{target}: written; to swim it: {command}", err=run.as_json)
    if run.kept_picture:
        from fishd.lab.identification.figure import draw

        draw(identification, run.kept_picture)


def _swim_experiment(
    run: Run, seconds: float, options: Sequence[str]
) -> "tuple[Config, list[Any], ServoSettings | None]":
    """Swim an experiment, or the rest of one that is resumed.

    options: those of the fit, for the fits while the fish swims
    Return the start configuration of the fit, the tables of ticks and the settings of the servo.
    """
    from fishd.lab.identification import continue_experiment

    session, fish = run.session(), run.fish
    if fish.on == "simulation":
        config = fish.load()
    elif fish.file:
        config = load(fish.file, fish.overrides)
    else:
        config = adopt(deepcopy(session.config), fish.overrides)
    session.check_calibrated()
    run.open({"for": seconds})
    before: list[Any] = []
    if run.is_resumed and fish.on == "live":
        before = [open_run(path).frame() for path in list_recordings(run.folder)]
    tables: list[Any]
    since = sum(map(len, before)) * session.tick
    with run.swimming(seconds, since=since, logged=False) as show, ExitStack() as stack:
        if fish.on == "live" and isinstance(show, Bar | Reports):
            fits = EarlyFits(run, config, options, show, since)
            stack.enter_context(session.heard_by(stack.enter_context(closing(fits))))
        tables = continue_experiment(session, before, seconds)
    run.check("before the fit")
    if run.uses_tail:  # only recordings have each fin angle
        tables = [open_run(path) for path in list_recordings(run.folder)]
    return config, tables, session.servo


class EarlyFits:
    """A listener of a live session that shows constants of the fish while it swims.

    Each fit is `fishctl identify` on the recordings, in a process of low priority. It begins with
    the values of the fit before it; one that fails shows nothing.
    """

    def __init__(
        self, run: Run, config: Config, options: Sequence[str], show: Lines, since: float
    ) -> None:
        """config: start of the first fit; since: length of the finished part [s]"""
        from fishd.lab.identification.estimation import LAW, POSSIBLE

        self._run, self._options, self._show, self._since = run, options, show, since
        values = asdict(config.plant) | {"rotation": config.simulation.rotation}
        self._values = {name: values[name] for name in (LAW, *POSSIBLE)}
        self._due = FIRST_FIT_S
        self._process: subprocess.Popen[bytes] | None = None

    def tick(self, _: Tick) -> None:
        """Begin a fit that is due, or show the result of one that has ended."""
        seconds = self._since + self._run.session().used
        if self._process is None and seconds >= self._due:
            self._due = FIT_GROWTH * seconds
            with suppress(OSError):  # such as a lack of memory
                self._process = self._start_fit()
        elif self._process and self._process.poll() is not None:
            output, _errors = self._process.communicate()
            if self._process.returncode == 0:
                with suppress(json.JSONDecodeError):  # where a package prints, too
                    self._show_result(json.loads(output))
            self._process = None

    def event(self, _: Event) -> None:
        """Ignore an event."""

    def close(self) -> None:
        """End the fit that goes on."""
        if self._process:
            self._process.kill()
            self._process.communicate()

    def _start_fit(self) -> "subprocess.Popen[bytes]":
        section = {"rotation": "simulation"}
        start = [f"--set={section.get(n, 'plant')}.{n}={v}" for n, v in self._values.items()]
        paths = map(str, list_recordings(self._run.folder))
        return subprocess.Popen(
            fishctl_command(["identify", "--json", *self._options, *start, "--", *paths]),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"OMP_NUM_THREADS": "1"},  # more only double the load
        )

    def _show_result(self, result: dict[str, Any]) -> None:
        """Show a fit, and begin the next one with its values."""
        if not result["identified"]:
            return
        fitted = result["estimates"]
        self._values |= {name: fitted[name]["value"] for name in self._values if name in fitted}
        self._values["servo_law"] = result["servo_law"]
        fitted |= result["products"]
        known = [
            (name, values["value"], values["ci95_low"], values["ci95_high"], values["unit"])
            for name in SHOWN
            if "if_ratio_holds" not in (values := fitted[name])
            and values["ci95_low"] < values["ci95_high"]
        ]
        if known:
            name, value, low, high, unit = known[0]
            point = CurvePoint(result["seconds"], value, (high - low) / 2, "time [s]", name, unit)
            self._show.estimate([Estimate(*values) for values in known], point)


def _print_result(identification: "Identification", origin: str) -> None:
    from fishd.lab.identification.figure import format_estimate, format_if_ratio_holds

    echo(identification.headline)
    echo()
    ratio, fin_angle = identification["lateral_inertia_ratio"].value, identification.fin_angle
    fitted = [
        estimate
        for estimate in (
            *identification.estimates,
            *(fin_angle.estimates if fin_angle else ()),
            *identification.products,
        )
        if estimate.fitted
    ]
    rows = [("", "value", "95 % interval", "unit", f"if K_y/K = {ratio:g}")]
    rows += [(*format_estimate(estimate), format_if_ratio_holds(estimate)) for estimate in fitted]
    columns = 5 if any(row[4] for row in rows[1:]) else 4
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    for name, value, interval, unit, if_ratio_holds in rows:
        line = f"{name:<{widths[0]}}  {value:>{widths[1]}}  {interval:<{widths[2]}}"
        line += f"  {unit:<{widths[3]}}" + (f"  {if_ratio_holds}" if columns == 5 else "")
        echo(line.rstrip())
    echo()
    if columns == 5:
        echo(
            "the forces do not determine K_y/K: --fix lateral_inertia_ratio keeps the configured "
            "value"
        )
    echo(f"servo_law: {identification.servo_law}")
    for channel, symbol in zip(identification.channels, ("F_x", "F_y"), strict=True):
        noise, drift = channel.noise * 1e3, 0.5 * channel.drift * 1e3
        echo(f"{symbol}: noise {noise:.2f} mN, drift ±{drift:.1f} mN")
    if fin_angle:
        echo(
            f"fin angle: noise {fin_angle.noise * 1e3:.2f} mrad, in {fin_angle.used} pictures"
            + (f", without {fin_angle.left_out} others" if fin_angle.left_out else "")
        )
    parts = (
        ""
        if identification.passages == 1
        else f", in {identification.passages} parts without a gap"
    )
    echo(f"fitted to {identification.seconds:.0f} s of swimming{parts}")
    echo(f"from {origin}")

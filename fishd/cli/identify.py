"""The verb that identifies a fish from its forces."""

import shlex
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.config import set_option
from fishd.cli.lease_options import take_option, verb_lease
from fishd.cli.options import FiniteRange, endpoint_option, json_option
from fishd.cli.output import echo, print_json
from fishd.cli.recording.choice import folder_option
from fishd.client import Fish
from fishd.config import Config, adopt, check_tethered, load
from fishd.core import files
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError
from fishd.core.process.interruption import interrupted_once
from fishd.recording.folder import find, named

if TYPE_CHECKING:
    from fishd.lab.identification import Identification


@click.command()
@click.argument("runs", nargs=-1, metavar="[RUN]...")
@click.option("--experiment", is_flag=True, help="First let a fish swim what tells most about it.")
@click.option(
    "--on",
    type=click.Choice(["simulation", "robot"]),
    help="With --experiment: a fish simulated in virtual time, or that of the fishd that runs, "
    "real or not. [default: simulation]",
)
@click.option(
    "--for",
    "seconds",
    type=FiniteRange(min=30.0, max=3600.0),
    help="With --experiment: how long it takes. [default: 180]",
)
@click.option(
    "--record",
    metavar="RUN",
    help="With --experiment: keep its ticks, as a recording: a path, or a name in the folder of "
    "recordings.",
)
@folder_option
@click.option(
    "--config",
    "file",
    type=click.Path(path_type=Path, readable=False),
    help="Configuration that a fit begins with, and of the simulated fish. [default: that of "
    "the running fishd for --on robot, else the defaults]",
)
@set_option
@click.option(
    "--fit",
    metavar="NAME,...",
    help="What to fit; the rest is as in the configuration. [default: omega0, xi, quadratic_drag, "
    "coupling, servo_speed, servo_lag, thrust_coefficient, lateral_inertia_ratio, lateral_drag, "
    "servo_delay, backlash, rotation; and where the forces show it lateral_quadratic_drag, "
    "cable_slack, servo_dead_zone, servo_reaction]",
)
@click.option(
    "--fix",
    metavar="NAME,...",
    help="What not to fit, as it is known: lateral_inertia_ratio where K_y = K, or coupling where "
    "λ was measured.",
)
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write the sections plant and simulation of a configuration into this file.",
)
@click.option("--force", is_flag=True, help="Overwrite FILE.")
@click.option(
    "--plot",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Draw forces, fit and residual into this file (.png, .svg, .pdf).",
)
@endpoint_option
@take_option
@json_option
def identify(
    runs: tuple[str, ...],
    experiment: bool,
    on: str | None,
    seconds: float | None,
    record: str | None,
    folder: Path | None,
    file: Path | None,
    overrides: tuple[str, ...],
    fit: str | None,
    fix: str | None,
    target: Path | None,
    force: bool,
    plot: Path | None,
    endpoint: str | None,
    as_json: bool,
) -> int:
    """Identify a fish and its rig from F_x, F_y and φ_c, with 95 % intervals.

    RUN is a path, a name in the folder of recordings, or 'latest'. Several are fitted together, as
    one fish. Or let --experiment swim one now.

    --to writes what `fishd --config` and `fishctl simulate --config` read.
    """
    if experiment == bool(runs):
        raise click.UsageError("name recordings to identify, or use --experiment: one of the two")
    for option, value in (("--on", on), ("--for", seconds), ("--record", record)):
        if value is not None and not experiment:
            raise click.UsageError(f"{option} goes with --experiment")
    if target and target.exists() and not force:
        raise FishdError(f"{target}: exists already; --force overwrites it, --to names another")
    kept = named(record, folder) if record else None
    if kept and kept.exists():
        raise FishdError(f"{kept}: exists already; --record names another")
    if plot:
        from fishd.lab.drawing import check

        check(plot)

    from fishd.lab import identification as lab

    names = None if fit is None else _names(fit)
    known = _names(fix or "")
    lab.check(lab.DEFAULT if names is None else names, known)  # before minutes of swimming
    if experiment:
        config, fish = _config(on, file, overrides, endpoint)
        try:
            tables: list[Any] = [_swum(config, fish, seconds or 180.0, kept)]
        except KeyboardInterrupt:
            where = f"; what it swam is in {kept}" if kept and kept.exists() else ""
            echo(f"fishctl: stopped before its end, so nothing is fitted{where}", err=True)
            return INTERRUPTED
        origin = f"an experiment with {_swimmer(on, file, overrides)}"
    else:
        config, tables = load(file, overrides), [find(run, folder) for run in runs]
        check_tethered(config.robot, "identify")
        origin = ", ".join(path.name for path in tables)
    found = lab.identify(tables, start=config.plant, rig=config.simulation, fit=names, fix=known)
    if as_json:
        print_json(found.to_builtins() | {"origin": origin})
    else:
        _print(found)
        defaults = experiment and on != "robot" and not file
        echo(f"from {origin}" + ("; --config names another" if defaults else ""))
    for remark in found.remarks:
        echo(f"fishctl: careful: {remark}", err=True)
    if target:
        _write(target, found.to_yaml(f"{origin} on {datetime.now():%Y-%m-%d}"))
    if plot:
        from fishd.lab.identification.figure import draw

        draw(found, plot)
    return 0


def _names(listed: str) -> tuple[str, ...]:
    return tuple(filter(None, listed.replace(" ", "").split(",")))


def _swimmer(on: str | None, file: Path | None, overrides: tuple[str, ...]) -> str:
    """Which fish swims an experiment, in words."""
    if on == "robot":
        return "the fish of fishd"
    fish = f"the simulated fish of {file}" if file else "the default fish"
    return f"{fish}, changed by --set" if overrides else fish


def _config(
    on: str | None, file: Path | None, overrides: tuple[str, ...], endpoint: str | None
) -> tuple[Config, Fish | None]:
    """The configuration that a fit begins with, and the fish of the fishd that runs, if that swims.

    Raises `ConfigError`, and `NoDaemon`.
    """
    if on != "robot":
        config = load(file, overrides)
        check_tethered(config.robot, "identify")
        return config, None
    fish = Fish(endpoint)
    return load(file, overrides) if file else adopt(fish.config(), overrides), fish


def _swum(config: Config, fish: Fish | None, seconds: float, record: Path | None) -> Any:
    """The ticks of an experiment, and a recording of them where one is wanted."""
    from fishd.lab.identification import experiment
    from fishd.lab.rig import LiveRig, Rig, VirtualRig
    from fishd.lab.rig_recording import recorded

    with ExitStack() as stack:
        stack.enter_context(interrupted_once())
        rig: Rig
        rig = LiveRig(stack.enter_context(fish), *verb_lease()) if fish else VirtualRig(config)
        stack.enter_context(rig)
        if rig.unit != "N":
            raise FishdError(
                "the force sensor is not calibrated, so no force is known in newtons: "
                "fishctl calibrate force"
            )
        if record:
            stack.enter_context(recorded(rig, record, "fishctl identify --experiment"))
        if fish:
            echo(f"fishctl: it swims for {seconds:g} s; Ctrl-C stops it", err=True)
        return experiment(rig, seconds)


def _write(target: Path, text: str) -> None:
    try:
        files.write_atomically(target, text)
    except OSError as error:
        raise FishdError(f"{target}: cannot be written: {error.strerror}") from None
    echo(
        f"{target}: written; to swim it: fishctl simulate swing --config {shlex.quote(str(target))}"
    )


def _print(found: "Identification") -> None:
    from fishd.lab.identification.formatting import format_estimate, format_if_ratio_holds

    echo(found.headline)
    echo()
    ratio = found["lateral_inertia_ratio"].value
    shown = [each for each in (*found.estimates, *found.products) if each.fitted]
    rows = [("", "value", "95 % interval", "unit", f"if K_y/K = {ratio:g}")]
    rows += [(*format_estimate(each), format_if_ratio_holds(each)) for each in shown]
    columns = 5 if any(row[4] for row in rows[1:]) else 4
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    for name, value, interval, unit, narrow in rows:
        line = f"{name:<{widths[0]}}  {value:>{widths[1]}}  {interval:<{widths[2]}}"
        line += f"  {unit:<{widths[3]}}" + (f"  {narrow}" if columns == 5 else "")
        echo(line.rstrip())
    echo()
    if columns == 5:
        echo("forces do not tell K_y/K: --fix lateral_inertia_ratio takes it as known")
    for channel, symbol in zip(found.channels, ("F_x", "F_y"), strict=True):
        rest = f"noise {channel.noise * 1e3:.2f} mN, drift ±{0.5 * channel.drift * 1e3:.1f} mN"
        echo(f"{symbol}: {channel.explained:.3%} of it explained; {rest}")
    parts = "" if found.passages == 1 else f", in {found.passages} parts without a gap"
    echo(f"fitted to {found.seconds:.0f} s of swimming{parts}")

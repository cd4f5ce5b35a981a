"""The `fishctl` command: its verbs, loaded when they are called, and how errors look."""

import sys
from importlib import import_module

import click
import msgspec

from fishd import __version__
from fishd.console import complain, run
from fishd.errors import FishdError, Refused

# verb: (module in fishd.cli, command in it, one line of help)
VERBS = {
    "status": ("control", "status", "Show what the daemon is doing, and how well."),
    "watch": ("watch", "watch", "Watch force, command and timing live."),
    "controllers": ("control", "controllers", "List the controllers and their parameters."),
    "policies": ("policies", "policies", "List the named policies, or show one."),
    "set-controller": ("control", "set_controller", "Put another controller in command."),
    "set-parameter": ("control", "set_parameter", "Change parameters while the fish swims."),
    "stop": ("control", "stop", "Fade to neutral and stay there."),
    "estop": ("control", "estop", "Emergency stop: no more pulses, at once."),
    "clear-fault": ("control", "clear_fault", "Leave mode fault or estop."),
    "mark": ("control", "mark", "Put a mark in the event stream."),
    "doctor": ("doctor", "doctor", "Check this machine, and say how to mend it."),
    "tare": ("calibrate", "tare", "Call the present force zero."),
    "calibrate": ("calibrate", "calibrate", "Calibrate the force sensor or the servo."),
    "release": ("release", "release", "Last resort without the daemon: neutral, then no pulses."),
    "virtual-pi": ("virtual_pi", "virtual_pi", "Run a virtual Raspberry Pi, and break it."),
    "simulate": ("simulate", "simulate", "Swim a simulated fish in virtual time."),
    "learn": ("learn", "learn", "Train policies, write them to files, compare them."),
    "config": ("config", "config", "Check, show and explain the configuration."),
    "completion": ("completion", "completion", "Print the completion script of a shell."),
}


class Verbs(click.Group):
    """A group that imports the module of a verb only when that verb is called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All verbs, in the order of the table."""
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a verb."""
        if cmd_name not in VERBS:
            return None
        module, attribute, _ = VERBS[cmd_name]
        command: click.Command = getattr(import_module(f"fishd.cli.{module}"), attribute)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs without importing any."""
        with formatter.section("Verbs"):
            formatter.write_dl([(verb, about) for verb, (_, _, about) in VERBS.items()])


@click.group(cls=Verbs, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--endpoint", metavar="ADDRESS", help="Control socket of the daemon to talk to.")
@click.version_option(__version__, prog_name="fishctl")
@click.pass_context
def fishctl(ctx: click.Context, endpoint: str | None) -> None:
    """Talk to fishd, the daemon that runs a robotic fish, or swim a simulated one."""
    ctx.obj = endpoint


def main() -> None:
    """Run fishctl; every error is one line on standard error.

    Exit status: 0, 1 when the daemon refused or does not answer, 2 for a wrong command line.
    """
    try:
        sys.exit(run(fishctl, "fishctl"))
    except Refused as error:
        complain("fishctl", f"{error} [{error.code}]", 1)
    except FishdError as error:
        complain("fishctl", str(error), 1)
    except msgspec.DecodeError as error:
        complain("fishctl", f"what answers at this endpoint is no fishd: {error}", 1)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # the reader, `head` say, has seen enough
        sys.stderr.close()
        sys.exit(0)
    except OSError as error:
        complain("fishctl", f"the output cannot be written: {error.strerror}", 1)

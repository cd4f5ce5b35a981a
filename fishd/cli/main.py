"""The `fishctl` command: its verbs, loaded when they are called, and its error messages."""

import gc
import os
import sys
import warnings

import click

from fishd import __version__
from fishd.cli.verbs import Verb, Verbs
from fishd.core.console import INTERRUPTED, complain, run
from fishd.core.errors import FishdError, Refused

VERBS = {
    "Watch": {
        "status": Verb("status", "status", "Show what the fish and its daemon are doing."),
        "watch": Verb("watch", "watch", "Watch force, command and timing live."),
        "window": Verb("window", "window", "Show and control the fish on a web page."),
        "mark": Verb("control", "mark", "Put a mark in the event stream."),
    },
    "Swim and stop": {
        "set-controller": Verb("control", "set_controller", "Set the controller of the fish."),
        "set-parameter": Verb("control", "set_parameter", "Change parameters while it swims."),
        "stop": Verb("control", "stop", "Fade to neutral and stay there."),
        "estop": Verb("estop", "estop", "Emergency stop: no more pulses, at once."),
        "clear-fault": Verb("control", "clear_fault", "Leave mode fault or estop."),
        "restart": Verb("control", "restart", "Restart fishd, to read its configuration again."),
        "release": Verb(
            "release", "release", "Last resort without the daemon: neutral, then no pulses."
        ),
        "controllers": Verb("listing", "controllers", "List the controllers and their parameters."),
        "agent": Verb("agent", "agent", "Let a policy outside fishd swim the fish."),
        "policies": Verb("listing", "policies", "List the named policies, or show one."),
    },
    "Experiment": {
        "measure": Verb("measure", "measure", "Measure a controller's thrust, with its interval."),
        "compare": Verb("compare", "compare", "Compare controllers and policies on one fish."),
        "sweep": Verb("sweep", "sweep", "Measure thrust over a grid of parameters."),
        "optimise": Verb("optimise", "optimise", "Find the best parameters of a controller."),
        "identify": Verb("identify", "identify", "Fit a fish to its forces, with intervals."),
        "adapt": Verb("adapt", "adapt", "Find a new fish's best gait: fit, train, measure."),
        "queue": Verb("queue", "queue", "Run experiments one after another, overnight too."),
        "optimum": Verb("optimum", "optimum", "Show the command with the largest thrust."),
    },
    "Record": {
        "record": Verb("recording.record", "record", "Record a running fish into a file."),
        "runs": Verb("recording.runs", "runs", "List recordings and experiments."),
        "plot": Verb("recording.files", "plot", "Draw a recording as a picture."),
        "export": Verb("recording.files", "export", "Write a recording as CSV or Parquet."),
        "import": Verb(
            "recording.import_table", "import_table", "Make a recording of a table of another rig."
        ),
        "replay": Verb("recording.files", "replay", "Publish a recording, as if it were live."),
        "rerun": Verb("recording.rerun", "rerun", "Run a controller again on a recording."),
        "recover": Verb("recording.files", "recover", "Repair a recording that was cut off."),
    },
    "Camera": {
        "camera": Verb("camera", "camera", "Show the picture of the camera, set it up."),
    },
    "Calibrate": {
        "tare": Verb("calibrate", "tare", "Set the force zero to the present force."),
        "calibrate": Verb("calibrate", "calibrate", "Calibrate the force sensor or the servo."),
    },
    "Simulate and learn": {
        "simulate": Verb("simulate", "simulate", "Swim a simulated fish in virtual time."),
        "swimmer": Verb("swimmer", "swimmer", "Draw a fish that swims freely, and its wake."),
        "learn": Verb("learn", "learn", "Train policies, and write them to files."),
        "virtual-pi": Verb(
            "virtual_pi", "virtual_pi", "Run a virtual Raspberry Pi, and inject faults."
        ),
    },
    "Check and configure": {
        "doctor": Verb("doctor", "doctor", "Check this machine, and print remedies."),
        "config": Verb("config", "config", "Check and show the configuration, print its schema."),
        "keygen": Verb("keygen", "keygen", "Make a key for access over the network."),
        "completion": Verb("completion", "completion", "Print the completion script of a shell."),
    },
}

DAILY_VERBS = (
    *("status", "watch", "set-controller", "stop", "measure"),
    *("compare", "record", "runs", "plot", "simulate"),
)
"""Verbs that help marks as those for every day."""
WORD_HINTS = {
    "help": "'fishctl --help' lists the verbs, 'fishctl VERB --help' explains one",
    "list": "did you mean 'controllers', 'policies' or 'runs'?",
    "run": "did you mean 'set-controller', 'simulate' or 'runs'?",
    "start": "did you mean 'set-controller'? 'fishd' starts the daemon",
    "swim": "did you mean 'set-controller', or 'simulate' for a fish in virtual time?",
}
"""Hints for words that other programs use as verbs."""


@click.group(
    cls=Verbs,
    verbs=VERBS,
    daily=DAILY_VERBS,
    word_hints=WORD_HINTS,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.option("--endpoint", metavar="ADDRESS", help="Control socket of the daemon to talk to.")
@click.option("--keys", metavar="FOLDER", help="Keys for access over the network.")
@click.version_option(__version__, prog_name="fishctl")
@click.pass_context
def fishctl(ctx: click.Context, endpoint: str | None, keys: str | None) -> None:
    """Talk to fishd, the daemon that runs a robotic fish, or swim a simulated one."""
    ctx.obj = endpoint
    if keys:
        from fishd.core.addresses import KEYS_VARIABLE

        os.environ[KEYS_VARIABLE] = keys  # also for the programs that this one starts


def main() -> None:
    """Run fishctl; every error is one line on standard error.

    Exit status: 0, 1 when the daemon refused or does not answer, 2 for a wrong command line.
    """
    # joblib warns on systems without semaphores; a verb that needs them reports it itself.
    warnings.filterwarnings("ignore", message=".*joblib will operate in serial mode")
    try:
        sys.exit(run(fishctl, "fishctl"))
    except Refused as error:
        complain("fishctl", f"{error} [{error.code}]", 1)
    except FishdError as error:
        complain("fishctl", str(error), 1)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    finally:
        gc.freeze()  # spares the collection at exit

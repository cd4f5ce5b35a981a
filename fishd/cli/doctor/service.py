"""Checks of the daemon: whether it runs, its addresses, and its systemd unit."""

from contextlib import suppress
from pathlib import Path

import msgspec

from fishd.cli.doctor.base import ANSWER_TIMEOUT_S, Context, Running, Unreachable, is_unused
from fishd.core import addresses, local_daemons
from fishd.core.errors import FishError, StartupError
from fishd.core.process.unix_sockets import is_open_to_all
from fishd.hardware.checks import Check, Result, fail, ok, on_this_machine, skipped, warning

UNIT = "fishd.service"
_UNIT_FOLDERS = ("/etc/systemd/system", "/usr/local/lib/systemd/system", "/usr/lib/systemd/system")


def daemon(context: Context) -> Result:
    """Check whether a fishd runs, and its state."""
    if context.daemon is None:
        if context.owner:
            return warning(
                f"no fishd at {context.endpoint or addresses.find_control_address()}, but "
                f"{context.owner}",
                "name its control.address with --endpoint",
            )
        if others := local_daemons.find_all():
            return warning(
                f"no fishd at {context.endpoint or addresses.find_control_address()}, but "
                f"{local_daemons.describe(others)}",
                "name the one that you mean with --endpoint",
            )
        return ok("no fishd is running")
    if isinstance(context.daemon, Unreachable):
        result = fail if context.daemon.is_hung else warning
        return result(context.daemon.why, context.suggest_remedy(context.daemon))
    status, endpoint = context.daemon.status, context.daemon.endpoint
    option = f" --endpoint {endpoint}" if context.daemon.detour and endpoint else ""
    message = f"fishd {status.version} (pid {status.pid}), robot {status.robot}, {status.mode}"
    if status.robot != context.config.robot:
        return warning(
            f"{message}; this configuration is for robot {context.config.robot}",
            f"check the configuration of the fishd at {endpoint}: --config FILE",
        )
    if status.reason:
        return fail(
            f"{message}: {status.reason.code}: {status.reason.message}",
            f"mend the cause, then fishctl clear-fault{option}",
        )
    if status.limitations:
        return warning(
            f"{message}; {'; '.join(status.limitations)}", "see docs/how-to/troubleshooting.md"
        )
    if context.daemon.detour:
        remedy = f"name it:{option}, or export FISHD_ENDPOINT={endpoint}"
        return warning(f"{message}; {context.daemon.detour}", remedy)
    return ok(message)


def telemetry(context: Context) -> Result:
    """Check that the address of telemetry is free, or used by the daemon."""
    return _check_address(context, context.config.telemetry.address, "telemetry.address")


def control(context: Context) -> Result:
    """Check that the control address is free, or used by the daemon."""
    served = None
    if isinstance(context.daemon, Running):
        served = context.daemon.endpoint
        if not context.daemon.status.control:
            return fail("clients cannot reach it, and fishd cannot create it again", "see 'daemon'")
    try:
        address = context.config.control.address or served or addresses.control_address()
    except StartupError as error:
        return fail(str(error), "set control.address, or run this as the user whose folder it is")
    return _check_address(context, address, "control.address")


def unit(context: Context) -> Result:
    """Check that the systemd unit is installed and enabled, by the files that systemd reads."""
    if not context.path("/run/systemd/system").is_dir():
        return skipped("systemd does not run on this machine")
    folders = [folder for folder in _UNIT_FOLDERS if context.path(f"{folder}/{UNIT}").exists()]
    if not folders:
        return warning(
            f"{UNIT} is not installed: fishd does not start by itself",
            "install the Debian package of fishd",
        )
    wants = context.path(_UNIT_FOLDERS[0]).glob(f"*.wants/{UNIT}")
    if not any(True for _ in wants):
        return warning(f"{UNIT} is not enabled", f"sudo systemctl enable --now {UNIT}")
    return ok(f"{Path(folders[0]) / UNIT}, enabled")


def camera(context: Context) -> Result | None:
    """Check the fishd-camera of this machine, if one runs."""
    try:
        from fishd.camera import requests  # imports numpy, which no other check needs
    except ImportError:
        return None
    address = requests.find_camera()
    with suppress(PermissionError):
        if is_unused(address):
            return None
    try:
        with requests.CameraRequests(address, ANSWER_TIMEOUT_S) as client:
            state = client.status()
    except (FishError, msgspec.MsgspecError) as error:
        return warning(str(error), "see what listens there, or restart fishd-camera")
    if state.state != "streaming":
        return warning(f"{state.state}: {state.problem}", state.remedy)
    lost = (
        f", {state.dropped_frames} lost, {state.broken_frames} broken"
        if state.dropped_frames + state.broken_frames
        else ""
    )
    message = f"{state.rate:.1f} frames a second from {state.device}{lost}"
    if state.limitations:
        return warning(f"{message}; {'; '.join(state.limitations)}", "see docs/how-to/camera.md")
    return ok(message)


def _check_address(context: Context, address: str, key: str) -> Result:
    daemon = context.daemon
    if isinstance(daemon, Unreachable):  # binding could take its socket away
        return skipped("not tried: a fishd may use it; see 'daemon'")
    if (path := addresses.socket_path(address)) and is_open_to_all(path.parent):
        return warning(
            f"every user of this machine may replace {address}", f"chmod o-w {path.parent}"
        )
    if daemon and address in (daemon.status.telemetry, daemon.endpoint):
        return ok(f"{address} is served by the running fishd")
    try:
        with addresses.claim_address(address), addresses.listen(address, key):
            pass
    except StartupError as error:
        return fail(str(error), f"stop what uses it, or set {key} to another address")
    return ok(f"{address} is free")


CHECKS = (
    Check("daemon", daemon),
    Check("telemetry", telemetry),
    Check("control", control),
    Check("camera", camera),
    Check("systemd", unit, on_this_machine),
)

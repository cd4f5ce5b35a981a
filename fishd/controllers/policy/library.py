"""Named policies: which there are, and what a name stands for.

`swim42` is the file `swim42.onnx` in the first of these folders that has one: those of
$FISHD_POLICIES, `policies` in the state folder, /etc/fishd/policies, and what comes with fishd.
"""

import os
from pathlib import Path

from fishd.errors import PolicyError
from fishd.policies.info import PolicyInfo
from fishd.schema import names_file, nearest

SUFFIX = ".onnx"
FOLDERS_VARIABLE = "FISHD_POLICIES"

_SYSTEM = Path("/etc/fishd/policies")


def folders() -> list[Path]:
    """Where policies are looked for, in this order; not all need be there."""
    given = os.environ.get(FOLDERS_VARIABLE, "").split(os.pathsep)
    return [
        *(Path(folder).expanduser().absolute() for folder in given if folder),
        _state_folder() / "policies",
        _SYSTEM,
        _shipped(),
    ]


def names() -> list[str]:
    """All names, sorted."""
    return sorted(_files())


def find(text: str) -> Path:
    """The file of a policy: `text` is its name, or a path, as it has a slash or ends in .onnx.

    Raises `PolicyError` for a name that is none; whether a path leads anywhere, reading tells.
    """
    if names_file(text, SUFFIX):
        return Path(text).expanduser()
    known = _files()
    if text not in known:
        raise PolicyError(unknown(text, sorted(known)))
    return known[text]


def describe_all(tick: float | None = None, amplitude: float | None = None) -> list[PolicyInfo]:
    """What there is to know about each named policy; arguments as for `describe`."""
    return [describe(name, tick, amplitude) for name in names()]


def describe(name: str, tick: float | None = None, amplitude: float | None = None) -> PolicyInfo:
    """What there is to know about a policy, by name or path.

    tick, amplitude: those of the robot [s], [rad]; a policy that does not fit them has a problem
    Raises `PolicyError` for a name that is none.
    """
    import msgspec

    from fishd.policies import file

    path, card, problem = find(name), None, ""
    try:
        card = file.read(path).card
        if tick is not None and amplitude is not None:
            card.check_fit(tick, amplitude)
    except PolicyError as error:
        problem = str(error).removeprefix(f"{path}: ")
    return PolicyInfo(
        name=path.stem,
        file=str(path),
        problem=problem,
        card=None if card is None else msgspec.to_builtins(card),
    )


def _files() -> dict[str, Path]:
    """The file of each name."""
    found: dict[str, Path] = {}
    for folder in folders():
        try:
            paths = sorted(folder.glob("*" + SUFFIX))
        except OSError:  # one folder that is not for us must not hide the others
            continue
        for path in paths:
            if path.stem and not path.stem.startswith(".") and path.stem.isprintable():
                found.setdefault(path.stem, path)
    return found


def unknown(name: str, known: list[str]) -> str:
    """What to say about a name that is none of those that are known."""
    if not known:
        return (
            f"no policy is named '{name}', there are none at all; put one into {folders()[0]}, or "
            f"give the path of a {SUFFIX} file"
        )
    hint = nearest(name, known)
    there_are = f" There are: {', '.join(known)}" if hint.startswith("did") else ""
    return f"no policy is named '{name}'; {hint}{there_are}"


def _state_folder() -> Path:
    service = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if service:
        return Path(service)
    return Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state").expanduser() / "fishd"


def _shipped() -> Path:
    """In the package once it is installed, else in the checkout."""
    package = Path(__file__).parent
    installed = package / "shipped"
    return installed if installed.is_dir() else package.parents[1] / "config" / "policies"

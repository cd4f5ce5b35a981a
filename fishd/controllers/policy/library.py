"""Named policies, and the files that their names refer to.

`swim42` is the file `swim42.onnx` in the first of these folders that has one: those of
$FISHD_POLICIES, `policies` in the state folder, /etc/fishd/policies, and what comes with fishd.
"""

import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from fishd.core import files
from fishd.core.errors import PolicyError
from fishd.core.protocol import PolicyInfo
from fishd.core.schema import names_file, suggest

if TYPE_CHECKING:
    from fishd.controllers.base import Limits
    from fishd.controllers.policy.file import PolicyFile

SUFFIX = ".onnx"
FOLDERS_VARIABLE = "FISHD_POLICIES"

_SYSTEM = Path("/etc/fishd/policies")


def folders() -> list[Path]:
    """Return the folders of policies in the order of the search; some may not exist."""
    configured = os.environ.get(FOLDERS_VARIABLE, "").split(os.pathsep)
    return [
        *(files.expand_user(folder).absolute() for folder in configured if folder),
        _state_folder() / "policies",
        _SYSTEM,
        _shipped_folder(),
    ]


def names() -> list[str]:
    """Return all names, sorted."""
    return sorted(_list_files())


def find(text: str) -> Path:
    """Return the file of a policy: `text` is a path, with a slash or .onnx at its end, or a name.

    Raises `PolicyError` for an unknown name, and for the folder of a training.
    """
    if names_file(text, SUFFIX):
        path = files.expand_user(text)
        if run := describe_training_folder(path):
            raise PolicyError(f"{path}: {run}")
        return path
    known = _list_files()
    if text not in known:
        if run := describe_training_folder(Path(text)):
            raise PolicyError(f"{text} {run}")
        raise PolicyError(unknown_name_message(text, sorted(known)))
    return known[text]


def open_policy(text: str, limits: "Limits") -> "PolicyFile":
    """Return the policy of a name or path if it fits these limits; else raise `PolicyError`."""
    from fishd.controllers.policy import file

    path = find(text)
    policy = file.read(path)
    try:
        policy.card.check_fit(limits.tick, limits.amplitude, limits.readings)
        if limits.scaled and any(
            feature.name == "fin_velocity" for feature in policy.card.observation
        ):
            raise PolicyError(
                "it was trained with the fin_velocity of estimator.kind: lateral_force, but "
                "fishd uses another kind"
            )
    except PolicyError as error:
        raise PolicyError(f"{path}: {error}") from None
    return policy


def describe_training_folder(path: Path) -> str:
    """Return a message if the path is a training's folder, checkpoint or model; else empty."""
    folder, what = (path.parent, "part") if path.name == "model.zip" else (path, "the folder")
    parents = folder, folder.parent
    if not (folder.is_dir() and any((at / "settings.yaml").is_file() for at in parents)):
        return ""
    return (
        f"is {what} of a training, not a policy file; export it first: fishctl learn export "
        f"{shlex.quote(str(folder))}"
    )


def describe_all(limits: "Limits | None" = None) -> list[PolicyInfo]:
    """Describe each named policy; see `describe`."""
    return [describe(name, limits) for name in names()]


def describe(name: str, limits: "Limits | None" = None) -> PolicyInfo:
    """Describe a policy, by name or path.

    limits: those of the robot; a policy that does not fit has a problem
    Raise `PolicyError` for an unknown name.
    """
    import msgspec

    from fishd.controllers.policy import file

    path, card, problem = find(name), None, ""
    try:
        card = file.read(path).card
        if limits:
            card.check_fit(limits.tick, limits.amplitude, limits.readings)
    except PolicyError as error:
        problem = str(error).removeprefix(f"{path}: ")
    return PolicyInfo(
        name=path.stem,
        file=str(path),
        problem=problem,
        card=None if card is None else msgspec.to_builtins(card),
        inputs="" if card is None else card.sees,
    )


def _list_files() -> dict[str, Path]:
    """Return the file of each name."""
    file_of_name: dict[str, Path] = {}
    for folder in folders():
        try:
            paths = sorted(folder.glob("*" + SUFFIX))
        except OSError:  # an unreadable folder must not hide the others
            continue
        for path in paths:
            if path.stem and not path.stem.startswith(".") and path.stem.isprintable():
                file_of_name.setdefault(path.stem, path)
    return file_of_name


def unknown_name_message(name: str, known: list[str]) -> str:
    """Return the message about an unknown name."""
    if not known:
        return (
            f"no policy is named '{name}', and none is installed; put one into {folders()[0]}, or "
            f"give the path of a {SUFFIX} file"
        )
    hint = suggest(name, known)
    available = f" There are: {', '.join(known)}" if hint.startswith("did") else ""
    return f"no policy is named '{name}'; {hint}{available}"


def _state_folder() -> Path:
    service = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if service:
        return Path(service)
    return files.expand_user(os.environ.get("XDG_STATE_HOME") or "~/.local/state") / "fishd"


def _shipped_folder() -> Path:
    return files.shipped_folder("config") / "policies"

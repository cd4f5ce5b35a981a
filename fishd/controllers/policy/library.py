"""Named policies: which exist, and which file a name stands for.

`swim42` is the file `swim42.onnx` in the first of these folders that has one: those of
$FISHD_POLICIES, `policies` in the state folder, /etc/fishd/policies, and what comes with fishd.
"""

import os
import shlex
from pathlib import Path

from fishd.core import files
from fishd.core.errors import PolicyError
from fishd.core.protocol import PolicyInfo
from fishd.core.schema import names_file, suggest

SUFFIX = ".onnx"
FOLDERS_VARIABLE = "FISHD_POLICIES"

_SYSTEM = Path("/etc/fishd/policies")


def folders() -> list[Path]:
    """Where policies are looked for, in this order; some may not exist."""
    given = os.environ.get(FOLDERS_VARIABLE, "").split(os.pathsep)
    return [
        *(files.expand_user(folder).absolute() for folder in given if folder),
        _state_folder() / "policies",
        _SYSTEM,
        _shipped_folder(),
    ]


def names() -> list[str]:
    """All names, sorted."""
    return sorted(_list_files())


def find(text: str) -> Path:
    """The file of a policy: `text` is its name, or a path, as it has a slash or ends in .onnx.

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


def describe_training_folder(path: Path) -> str:
    """What to say of the folder of a training, or of one of its checkpoints; else nothing."""
    if not (path.is_dir() and any((at / "settings.yaml").is_file() for at in (path, path.parent))):
        return ""
    return (
        "is the folder of a training, no policy file; export it first: fishctl learn export "
        f"{shlex.quote(str(path))}"
    )


def describe_all(tick: float | None = None, amplitude: float | None = None) -> list[PolicyInfo]:
    """`describe` each named policy."""
    return [describe(name, tick, amplitude) for name in names()]


def describe(name: str, tick: float | None = None, amplitude: float | None = None) -> PolicyInfo:
    """Describe a policy, by name or path.

    tick, amplitude: those of the robot [s], [rad]; a policy that does not fit them has a problem
    Raises `PolicyError` for an unknown name.
    """
    import msgspec

    from fishd.controllers.policy import file

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
        sees="" if card is None else card.sees,
    )


def _list_files() -> dict[str, Path]:
    """The file of each name."""
    found: dict[str, Path] = {}
    for folder in folders():
        try:
            paths = sorted(folder.glob("*" + SUFFIX))
        except OSError:  # one that this user may not read must not hide the others
            continue
        for path in paths:
            if path.stem and not path.stem.startswith(".") and path.stem.isprintable():
                found.setdefault(path.stem, path)
    return found


def unknown_name_message(name: str, known: list[str]) -> str:
    """The message about a name that is not among the known ones."""
    if not known:
        return (
            f"no policy is named '{name}', and no other was found; put one into {folders()[0]}, or "
            f"give the path of a {SUFFIX} file"
        )
    hint = suggest(name, known)
    there_are = f" There are: {', '.join(known)}" if hint.startswith("did") else ""
    return f"no policy is named '{name}'; {hint}{there_are}"


def _state_folder() -> Path:
    service = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if service:
        return Path(service)
    return files.expand_user(os.environ.get("XDG_STATE_HOME") or "~/.local/state") / "fishd"


def _shipped_folder() -> Path:
    """In the package once it is installed, else in the checkout."""
    package = Path(__file__).parent
    installed = package / "shipped"
    return installed if installed.is_dir() else package.parents[2] / "config" / "policies"

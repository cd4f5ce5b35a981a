"""Builds the packages of a release, checks them, and names the remaining steps; uploads nothing.

`make release` builds version X of CITATION.cff into dist/. `make packages` builds the present
state of the checkout, whatever its version, and checks it in the same way.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
UVX = Path(sys.executable).with_name("uvx")
TWINE = (UVX, "--quiet", "twine>=6.1")
"""Command of twine, from version 6.1 on, which knows the licence fields of PEP 639."""
EXTRAS = "lab,policy,window"
"""Extras with which the wheel is tried: for a figure, a policy and the page."""
PRETEND = "SETUPTOOLS_SCM_PRETEND_VERSION_FOR_FISHD"
"""Variable that sets the version before the tag exists."""
_STEPS = """
{dist} holds fishd {version}. What remains:
  git tag --annotate v{version} --message "fishd {version}"
  git push origin v{version}
  uvx sigstore sign dist/*         # optional; a browser asks who signs
  uvx twine upload dist/*.whl dist/*.tar.gz"""


def cited_version() -> str:
    """Return the version in CITATION.cff."""
    match = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    if match is None:
        sys.exit("CITATION.cff has no line 'version: X'")
    return match[1]


def logged_versions() -> list[str]:
    """Return the versions with a date in CHANGELOG.md, the newest first."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    return re.findall(r"^## \[([\d.]+)\] - \d{4}-\d\d-\d\d$", text, re.MULTILINE)


def find_obstacles(version: str) -> list[str]:
    """Return what has to change before this version can be released, as sentences."""
    obstacles = []
    if logged_versions()[:1] != [version]:
        obstacles.append(
            f"CHANGELOG.md: the section after [Unreleased] must be '## [{version}] - DATE', "
            f"for version {version} of CITATION.cff"
        )
    if changed := _output("git", "status", "--porcelain"):
        obstacles.append(f"uncommitted changes: {', '.join(changed.split()[1::2])}")
    tagged = _output("git", "tag", "--list", f"v{version}")
    if tagged and _output("git", "rev-parse", f"v{version}^{{commit}}") != _output(
        "git", "rev-parse", "HEAD"
    ):
        obstacles.append(f"v{version} is another commit already: raise the version in CITATION.cff")
    return obstacles


def build(folder: Path, version: str | None) -> tuple[Path, Path]:
    """Build sdist and wheel into an empty folder; exit if the sdist builds another wheel.

    version: None for the version that the history of git gives
    """
    environment = os.environ | ({PRETEND: version} if version else {})
    hatchling = [sys.executable, "-m", "hatchling", "build"]
    _run(*hatchling, "--directory", folder, cwd=ROOT, env=environment)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    with tempfile.TemporaryDirectory() as work:
        _run("tar", "-xf", sdist, "-C", work)
        source = Path(work, sdist.name.removesuffix(".tar.gz"))
        _run(*hatchling, "--target", "wheel", "--directory", work, cwd=source)
        if Path(work, wheel.name).read_bytes() != wheel.read_bytes():
            sys.exit(f"{sdist.name} builds another wheel than the checkout")
    return sdist, wheel


def check(sdist: Path, wheel: Path) -> None:
    """Check metadata and contents; exit if a tool complains."""
    _run(*TWINE, "check", "--strict", sdist, wheel)
    _run(UVX, "--quiet", "check-wheel-contents", wheel)


def try_wheel(wheel: Path) -> None:
    """Install the wheel as a user would, far from the repository; exit if a command fails."""
    with tempfile.TemporaryDirectory(prefix="fishd-wheel-") as name:
        folder = Path(name)
        _run(sys.executable, "-m", "venv", folder / "venv")
        pip = [folder / "venv/bin/python", "-m", "pip", "install", "--quiet"]
        _run(*pip, f"{wheel}[{EXTRAS}]")
        script = ROOT / "tools" / "try_wheel.sh"
        path = f"{folder / 'venv/bin'}:/usr/bin:/bin"
        environment = {name: value for name, value in os.environ.items() if "PYTHON" not in name}
        _run("bash", script, cwd=folder, env=environment | {"PATH": path, "HOME": name})


def _run(*command: str | Path, **options: object) -> None:
    try:
        subprocess.run(command, check=True, **options)  # type: ignore[call-overload]
    except subprocess.CalledProcessError as error:
        sys.exit(f"failed with exit status {error.returncode}: {' '.join(map(str, command))}")


def _output(*command: str) -> str:
    return subprocess.run(
        command, cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.strip()


def main(arguments: Sequence[str] | None = None) -> None:
    """Build, check and try the packages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rehearse", action="store_true", help="build the present checkout")
    rehearse = parser.parse_args(arguments).rehearse
    version = None if rehearse else cited_version()
    if version and (obstacles := find_obstacles(version)):
        sys.exit("\n".join(obstacles))
    DIST.mkdir(exist_ok=True)
    for old in DIST.glob("fishd-*"):
        old.unlink()
    packages = build(DIST, version)
    check(*packages)
    try_wheel(packages[1])
    for package in packages:
        print(f"{package.relative_to(ROOT)}: {package.stat().st_size / 1e6:.1f} MB")
    if version:
        print(_STEPS.format(dist=DIST, version=version))


if __name__ == "__main__":
    main()

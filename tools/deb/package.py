"""Debian package of fishd, which `python tools/deb [--machine arm64] [--python 3.13]` builds.

It brings a virtual environment in /usr/lib/fishd, as dh-virtualenv would make it, with the
packages of tools/locks. Nothing of it is compiled here, so that any machine builds for any other.
dpkg-deb packs it: it is part of Debian, which keeps it, and needs no rules beside this file.
"""

import argparse
import gzip
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from email.utils import formatdate
from pathlib import Path
from zipfile import ZipFile

import release

HERE = Path(__file__).resolve().parent
ROOT = release.ROOT
UV = Path(sys.executable).with_name("uv")
DEBIANS = {"3.11": 12, "3.13": 13}
"""Release of Debian by its Python."""
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
"""Name of a processor in Python's platforms, by Debian's."""
EXTRAS = ("pi", "record", "policy", "camera", "window", "rpi-lgpio")
MAINTAINER = "The fishd authors <fishd@localhost>"
HOME = "usr/lib/fishd"
"""Folder of the virtual environment."""
SYSTEM_FILES = {
    "*.service": "usr/lib/systemd/system",
    "pigpiod.service.d/*": "usr/lib/systemd/system/pigpiod.service.d",
    "sysusers.d/*": "usr/lib/sysusers.d",
    "tmpfiles.d/*": "usr/lib/tmpfiles.d",
    "modules-load.d/*": "usr/lib/modules-load.d",
    "udev/rules.d/*": "usr/lib/udev/rules.d",
}
"""Folder for the files of systemd/, by pattern."""
CONFIGS = {"pi": "fishd", "camera": "camera", "window": "window"}
"""Name in /etc/fishd of an example in config/."""
COMMANDS = ("fishd", "fishctl", "fishd-camera", "fishd-window")
"""Commands in /usr/bin."""
COMPLETIONS = {
    "bash": "usr/share/bash-completion/completions/fishctl",
    "zsh": "usr/share/zsh/vendor-completions/_fishctl",
    "fish": "usr/share/fish/vendor_completions.d/fishctl.fish",
}
"""Place of the completion script of a shell."""


def build(folder: Path, machine: str, python: str, compression: str) -> Path:
    """Build the package into a folder, and return its file.

    compression: option of dpkg-deb; the compression takes most of the time
    """
    with tempfile.TemporaryDirectory(prefix="fishd-deb-") as name:
        work, root = Path(name), Path(name, "root")
        _, wheel = release.build(work, None)
        version = debian_version(wheel.name.split("-")[1], python)
        install_packages(root, wheel, machine, python)
        install_system_files(root)
        install_commands(root)
        install_documents(root, wheel, version)
        write_control(root, machine, python, version)
        set_modes(root)
        package = folder / f"fishd_{version}_{machine}.deb"
        run("dpkg-deb", "--root-owner-group", compression, "--build", root, package)
    return package


def debian_version(version: str, python: str) -> str:
    """Return Debian's form of a version of Python: a development version sorts before its release.

    A package for a newer Debian is newer, so that the upgrade of a machine replaces it.
    """
    return f"{re.sub(r'[.](?=dev)|(?=rc|[ab][0-9])', '~', version, count=1)}-1~deb{DEBIANS[python]}"


def install_packages(root: Path, wheel: Path, machine: str, python: str) -> None:
    """Install fishd and its locked packages for a machine into a virtual environment."""
    home, site = root / HOME, root / HOME / "lib" / f"python{python}" / "site-packages"
    site.mkdir(parents=True)
    platform = ["--python-version", python]
    platform += ["--python-platform", f"{MACHINES[machine]}-manylinux_2_36"]
    locked = wheel.with_name("locked.txt")
    locked.write_text("".join(locked_entries(platform, python)))
    target = [UV, "pip", "install", "--quiet", "--no-config", "--no-deps", *platform]
    run(*target, "--target", site, "--require-hashes", "--requirement", locked)
    run(*target, "--target", site, wheel)
    shutil.rmtree(site / "bin")
    (site / ".lock").unlink(missing_ok=True)
    # Libraries to link with, tests, and Blinka's programs for the processors of other boards.
    for pattern in ("**/*.a", "*/tests", "**/pulseio/libgpiod_pulsein*"):
        for path in site.glob(pattern):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    (info,) = site.glob("fishd-*.dist-info")
    (info / "direct_url.json").unlink()
    (info / "INSTALLER").write_text("dpkg\n")
    if python == "3.13":  # no wheel of lgpio: Raspberry Pi OS has a package of it
        for name in ("lgpio.py", f"_lgpio.cpython-313-{MACHINES[machine]}-linux-gnu.so"):
            (site / name).symlink_to(f"/usr/lib/python3/dist-packages/{name}")
    (home / "bin").mkdir()
    (home / "bin" / "python").symlink_to(f"../../../bin/python{python}")
    (home / "pyvenv.cfg").write_text(
        f"home = /usr/bin\ninclude-system-site-packages = false\nversion = {python}\n"
    )
    with ZipFile(wheel) as archive:
        (entry_points,) = (n for n in archive.namelist() if n.endswith("entry_points.txt"))
        text = archive.read(entry_points).decode()
    for name, module, function in re.findall(r"^(\S+) = (\S+):(\S+)$", text, re.MULTILINE):
        write(
            home / "bin" / name,
            f"#!/{HOME}/bin/python -I\nfrom {module} import {function}\n\n{function}()\n",
            0o755,
        )
    write(home / "bin" / "fishd-upgrade", (HERE / "fishd-upgrade").read_text(), 0o755)


def locked_entries(platform: list[str], python: str) -> Iterator[str]:
    """Return the entries of the lock that the extras of the package need."""
    lock = (ROOT / "tools" / "locks" / f"python{python}.txt").read_text()
    pins = "\n".join(re.findall(r"^[\w.-]+==\S+", lock, re.MULTILINE))
    extras = [word for extra in EXTRAS for word in ("--extra", extra)]
    resolve = [UV, "pip", "compile", "--quiet", "--no-config", "--no-annotate", *platform, *extras]
    needed = subprocess.run(
        [*resolve, "--constraint", "-", ROOT / "pyproject.toml"],
        input=pins,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    for entry in re.split(r"^(?=\w)", lock, flags=re.MULTILINE):
        name = entry.partition(" ")[0]
        if name in needed and not (python == "3.13" and name.startswith("lgpio==")):
            yield entry


def install_system_files(root: Path) -> None:
    """Install what systemd and udev read, and the configuration."""
    for pattern, folder in SYSTEM_FILES.items():
        for source in sorted((ROOT / "systemd").glob(pattern)):
            write(root / folder / source.name, source.read_text())
    for source, target in CONFIGS.items():
        text = (ROOT / "config" / f"{source}.yaml").read_text()
        write(root / "etc" / "fishd" / f"{target}.yaml", text)


def install_commands(root: Path) -> None:
    """Install the commands, their manual pages and their completion."""
    (root / "usr" / "bin").mkdir()
    for name in COMMANDS:
        (root / "usr" / "bin" / name).symlink_to(f"../lib/fishd/bin/{name}")
        page = (ROOT / "build" / "docs" / "man" / f"{name}.1").read_bytes()
        write(root / "usr" / "share" / "man" / "man1" / f"{name}.1.gz", compress(page))
    fishctl = [sys.executable, "-c", "from fishd.__main__ import fishctl; fishctl()"]
    for shell, target in COMPLETIONS.items():
        script = subprocess.run(
            [*fishctl, "completion", shell], cwd=ROOT, check=True, capture_output=True, text=True
        ).stdout
        write(root / target, script)


def install_documents(root: Path, wheel: Path, version: str) -> None:
    """Install the web site, the examples, the licences and the list of changes."""
    documents = root / "usr" / "share" / "doc" / "fishd"
    without = shutil.ignore_patterns(".buildinfo", "objects.inv")
    shutil.copytree(ROOT / "build" / "docs" / "html", documents / "html", ignore=without)
    shutil.copytree(ROOT / "config", documents / "examples")
    licence = "".join(
        f" {line or '.'}\n" for line in (ROOT / "LICENSE").read_text().splitlines()[4:]
    )
    write(documents / "copyright", (HERE / "copyright").read_text() + licence)
    write(documents / "changelog.gz", compress((ROOT / "CHANGELOG.md").read_bytes()))
    date = formatdate(wheel.stat().st_mtime)
    entry = f"fishd ({version}) stable; urgency=medium\n\n  * See changelog.gz.\n\n"
    entry += f" -- {MAINTAINER}  {date}\n"
    write(documents / "changelog.Debian.gz", compress(entry.encode()))
    write(root / "usr/share/doc-base/fishd.fishd", (HERE / "doc-base").read_text())
    write(root / "usr/share/lintian/overrides/fishd", (HERE / "lintian-overrides").read_text())


def write_control(root: Path, machine: str, python: str, version: str) -> None:
    """Write the fields of the package, its conffiles, scripts and checksums."""
    folder = root / "DEBIAN"
    size = sum(path.lstat().st_size for path in root.rglob("*") if path.is_file()) // 1024
    recommends = "Recommends: python3-lgpio\n" if python == "3.13" else ""
    fields = (
        (HERE / "control")
        .read_text()
        .format(
            version=version,
            machine=machine,
            size=size,
            python=python,
            maintainer=MAINTAINER,
            recommends=recommends,
        )
    )
    write(folder / "control", fields)
    configs = sorted((root / "etc").rglob("*.yaml"))
    write(folder / "conffiles", "".join(f"/{path.relative_to(root)}\n" for path in configs))
    files = [p for p in sorted(root.rglob("*")) if p.is_file() and not p.is_symlink()]
    named = [p.relative_to(root) for p in files if p not in configs and folder not in p.parents]
    sums = subprocess.run(
        ["md5sum", "--", *named], cwd=root, check=True, capture_output=True, text=True
    ).stdout
    write(folder / "md5sums", sums)
    for name in ("preinst", "postinst", "prerm", "postrm"):
        write(folder / name, (HERE / name).read_text().replace("PYTHON", python), 0o755)


def set_modes(root: Path) -> None:
    """Make files and folders readable for all, and remove empty folders."""
    for path in sorted(root.rglob("*"), reverse=True):
        if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            path.rmdir()
        elif not path.is_symlink():
            runs = path.parent.name in ("bin", "DEBIAN") and path.stat().st_mode & 0o100
            path.chmod(0o755 if runs or path.is_dir() else 0o644)
    (root / "etc/fishd/camera.yaml").chmod(0o640)  # it may hold the password of a camera


def compress(content: bytes) -> bytes:
    """Return the content in gzip's format, without a time, as Debian wants it."""
    return gzip.compress(content, 9, mtime=0)


def write(path: Path, content: str | bytes, mode: int = 0o644) -> None:
    """Write a file and the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    path.chmod(mode)


def run(*command: str | Path) -> None:
    """Run a command; exit where it fails."""
    if code := subprocess.run(command, check=False).returncode:
        sys.exit(f"failed with exit status {code}: {' '.join(map(str, command))}")


def main() -> None:
    """Build the package of the command line."""
    parser = argparse.ArgumentParser(prog="tools/deb", description=__doc__)
    here = next((name for name in MACHINES if MACHINES[name] == platform.machine()), "amd64")
    parser.add_argument("--machine", choices=MACHINES, default=here)
    parser.add_argument("--python", choices=DEBIANS, default="3.11", help="that of the Debian")
    parser.add_argument("--to", type=Path, default=release.DIST, help="folder for the package")
    parser.add_argument("--fast", action="store_true", help="do not compress, for a trial")
    options = parser.parse_args()
    if not (ROOT / "build/docs/man/fishctl.1").exists():
        sys.exit("build/docs is missing: make docs")
    options.to.mkdir(exist_ok=True)
    package = build(
        options.to, options.machine, options.python, "-Znone" if options.fast else "-Zxz"
    )
    print(f"{package}: {package.stat().st_size / 1e6:.1f} MB")

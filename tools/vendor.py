"""Fetch the libraries of the window's page and of tests again, as manifest.json names them.

`tools/vendor.py` runs `npm pack` for each package, compares the archive with npm's integrity and
each file with its SHA-256, and writes the files. To change a version, edit it in manifest.json, and
empty `integrity` and `sha256`: they are then filled in.

The reader of recordings that a test uses has many files: esbuild makes one of them.
"""

import base64
import hashlib
import json
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
VENDOR = ROOT / "fishd" / "window" / "page" / "vendor"
OF_TESTS = ROOT / "tests" / "rigs" / "vendor"


def fetch(package: dict[str, Any], folder: Path) -> None:
    """Write the files of a package, and fill in missing hashes; exit if a hash differs."""
    name = f"{package['name']}@{package['version']}"
    command = ["npm", "pack", name, "--json", "--silent", "--pack-destination", str(folder)]
    answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    archive = folder / json.loads(answer)[0]["filename"]
    digest = base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
    check(name, package, "integrity", f"sha512-{digest}")
    with tarfile.open(archive) as files:
        description = files.extractfile("package/package.json")
        assert description
        check(name, package, "license", json.load(description)["license"])
        for entry in package["files"]:
            member = files.extractfile(f"package/{entry['source']}")
            if member is None:
                sys.exit(f"{name} has no file {entry['source']}")
            content = member.read()
            check(f"{name}/{entry['source']}", entry, "sha256", hashlib.sha256(content).hexdigest())
            (VENDOR / entry["file"]).write_bytes(content)


def check(what: str, entry: dict[str, Any], key: str, value: str) -> None:
    """Fill in a missing hash; exit if it differs from the one in manifest.json."""
    if entry.setdefault(key, value) not in ("", value):
        sys.exit(f"{what}: {key} is {value}, not {entry[key]} as in manifest.json")
    entry[key] = value


def make_bundle(manifest: dict[str, Any], folder: Path) -> None:
    """Write one file of several packages, and their licences; exit if its hash differs."""
    bundle, packages = manifest["bundle"], manifest["packages"]
    names = [f"{name}@{version}" for name, version in packages.items()]
    command = ["npm", "install", "--ignore-scripts", "--silent", "--prefix", str(folder), *names]
    subprocess.run(command, check=True)
    (folder / "source.mjs").write_text(bundle["source"], encoding="utf-8")
    esbuild = [str(folder / "node_modules" / ".bin" / "esbuild"), "source.mjs", "--bundle"]
    options = ["--platform=node", "--minify", "--legal-comments=inline", "--log-level=error"]
    made = subprocess.run([*esbuild, *options], check=True, cwd=folder, capture_output=True)
    check("the bundle", bundle, "sha256", hashlib.sha256(made.stdout).hexdigest())
    (OF_TESTS / bundle["file"]).write_bytes(made.stdout)
    licences = []
    for name, version in packages.items():
        if name != "esbuild":  # no code of it is in the file
            (licence,) = (folder / "node_modules" / name).glob("LICENSE*")
            text = licence.read_text(encoding="utf-8").replace("\r\n", "\n").strip()
            licences.append(f"{name} {version}\n\n{text}\n")
    (OF_TESTS / manifest["licences"]).write_text("\n".join(licences), encoding="utf-8")


def main() -> None:
    """Fetch all packages."""
    update(OF_TESTS / "manifest.json", make_bundle)
    update(VENDOR / "manifest.json", fetch_all)


def fetch_all(manifest: dict[str, Any], folder: Path) -> None:
    """Write the files of all packages."""
    for package in manifest["packages"]:
        fetch(package, folder)


def update(path: Path, get: Callable[[dict[str, Any], Path], None]) -> None:
    """Get what a manifest names, and store the manifest with its hashes."""
    manifest = json.loads(path.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        get(manifest, Path(folder))
    path.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""Fetch the libraries of the window's page again, as manifest.json names them.

`tools/vendor.py` runs `npm pack` for each package, compares the archive with npm's integrity and
each file with its SHA-256, and writes the files. To change a version, edit it in manifest.json, and
empty `integrity` and `sha256`: they are then filled in.
"""

import argparse
import base64
import hashlib
import json
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
VENDOR = ROOT / "fishd" / "window" / "page" / "vendor"


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


def main() -> None:
    """Fetch all packages, and store the manifest with their hashes."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    path = VENDOR / "manifest.json"
    manifest = json.loads(path.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        for package in manifest["packages"]:
            fetch(package, Path(folder))
    path.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

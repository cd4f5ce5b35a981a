"""Fetches films of real fish that others have published, and measures them with fishd.

The films stay in the folder; their licence is not that of fishd, so they are never shipped. A file
that is there already, such as one copied by hand, is not fetched again.
"""

import argparse
import hashlib
import subprocess
import sys
import urllib.request
from pathlib import Path

SOURCE = (
    "https://raw.githubusercontent.com/ckenaley/trackter/"
    "cb2db7278007cd577f5a64cd3a7e5b1eb5651f1a/inst/extdata/vid/"
)
LICENCE = "GPL-2.0-or-later, Christopher Kenaley"
RATE = "100"
"""Pictures a second; the files state another rate."""
FILMS = {
    "trout.avi": "084ae10870fbfc295d976a785a5fffb958f252b16b192538c32a3c2488e51fa5",
    "sunfish_pect.avi": "8e9bf43ebfd3a3febd589217e75e792f01d572f9ab73f32890963c238f7d0601",
}
"""SHA-256 of films of fish that keep their place in a flume."""
FISHCTL = [sys.executable, "-c", "from fishd.__main__ import fishctl; fishctl()"]


def fetch(name: str, path: Path) -> None:
    """Write a film into a file; raise `SystemExit` when it cannot be fetched."""
    try:
        with urllib.request.urlopen(SOURCE + name, timeout=60) as answer:
            path.write_bytes(answer.read())
    except OSError as error:
        raise SystemExit(f"not fetched: {SOURCE}{name}: {error}; or copy it to {path}") from None


def main() -> None:
    """Fetch and measure all films; raise `SystemExit` for a file that is not the expected one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, checksum in FILMS.items():
        path = folder / name
        if not path.exists():
            fetch(name, path)
        if hashlib.sha256(path.read_bytes()).hexdigest() != checksum:
            raise SystemExit(f"{path} is not the expected film: remove it, to fetch it again")
        print(f"{name} ({LICENCE})", flush=True)
        table, figure = path.with_suffix(".csv"), path.with_suffix(".png")
        table.unlink(missing_ok=True)
        words = ["camera", "measure", path, "--free", "--midline", "--rate", RATE]
        words += ["--to", table, "--plot", figure]
        if code := subprocess.run([*FISHCTL, *map(str, words)], check=False).returncode:
            raise SystemExit(code)


if __name__ == "__main__":
    main()

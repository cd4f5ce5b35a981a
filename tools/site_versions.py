"""Builds the web site of each released version and of the checkout, without a network.

`make docs-versions` writes build/site: a folder for each tag such as v0.1.0, `development` for the
checkout, and index.html, which lists them.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "build" / "site"
_PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>fishd: versions of the documentation</title>
<h1>fishd: versions of the documentation</h1>
<ul>
{entries}
</ul>
</html>
"""


def released_tags() -> list[str]:
    """Return the tags of releases, the newest first."""
    tags = ["git", "tag", "--list", "v[0-9]*", "--sort=-version:refname"]
    return subprocess.run(tags, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()


def build(source: Path, version: str) -> None:
    """Build the site of a source folder; exit where it has a warning."""
    folders = [source / "docs", SITE / version]
    sphinx = [sys.executable, "-P", "-m", "sphinx", "--quiet", "--fail-on-warning"]
    with tempfile.TemporaryDirectory() as parsed:
        options = ["--conf-dir", source / "docs" / "sphinx", "--doctree-dir", parsed]
        done = subprocess.run(
            [*sphinx, "-D", f"html_title=fishd {version}", *options, *folders],
            env=os.environ | {"PYTHONPATH": str(source)},
            check=False,
        )
    if done.returncode:
        sys.exit(f"the site of {version} could not be built")


def build_tag(tag: str) -> None:
    """Build the site of a tag from its own files."""
    with tempfile.TemporaryDirectory() as name:
        archive = Path(name, "source.tar")
        with archive.open("wb") as file:
            subprocess.run(["git", "archive", tag], cwd=ROOT, stdout=file, check=True)
        source = Path(name, "source")
        source.mkdir()
        subprocess.run(["tar", "-xf", archive, "-C", source], check=True)
        build(source, tag.removeprefix("v"))


def write_index(versions: list[str]) -> None:
    """Write the page that lists the versions."""
    entries = (f'<li><a href="{name}/README.html">{name}</a>' for name in versions)
    (SITE / "index.html").write_text(_PAGE.format(entries="\n".join(entries)), encoding="utf-8")


def main() -> None:
    """Build the sites that are missing, and that of the checkout."""
    versions = []
    for tag in released_tags():
        versions.append(re.sub("^v", "", tag))
        if not (SITE / versions[-1] / "README.html").exists():
            build_tag(tag)  # a tag does not change
    shutil.rmtree(SITE / "development", ignore_errors=True)
    build(ROOT, "development")
    write_index([*versions, "development"])
    print(f"Open {SITE / 'index.html'}")


if __name__ == "__main__":
    main()

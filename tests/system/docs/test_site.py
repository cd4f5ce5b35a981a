"""The site of `make docs`, built without a warning if numba and torch are not installed."""

import subprocess
import sys
from pathlib import Path

import pytest
from rigs.documents import ROOT

WITHOUT = """
import gc, sys

gc.disable()  # which takes a quarter of the time

class Missing:
    @staticmethod
    def find_spec(name, path=None, target=None):
        if name in ("numba", "torch", "gymnasium", "onnxruntime", "cv2"):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)

sys.meta_path.insert(0, Missing)
from sphinx.cmd.build import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_the_man_pages_have_every_verb_and_no_page_has_a_warning(tmp_path: Path) -> None:
    options = ["--quiet", "--fail-on-warning", "--conf-dir", str(ROOT / "docs" / "sphinx")]
    folders = [str(ROOT / "docs"), str(tmp_path)]
    built = subprocess.run(
        [sys.executable, "-c", WITHOUT, *options, "--builder", "man", *folders],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (built.returncode, built.stderr) == (0, "")
    page = (tmp_path / "fishctl.1").read_text(encoding="utf-8").replace("\\-", "-")
    for heading in ("measure", "swing", "midlines", "inject"):
        assert f".SS {heading}" in page
    assert "--longest-half-period" in page
    assert (tmp_path / "fishd.1").exists()

"""Build hook that writes the version of the tag into the `fishd/__init__.py` of a wheel."""

import re
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class VersionHook(BuildHookInterface):
    """Hook of wheels; the checkout and its editable installation keep their own version."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Put a copy of the file with the version of the wheel into its place."""
        if version == "editable":
            return
        text = Path(self.root, "fishd", "__init__.py").read_text(encoding="utf-8")
        line = f'__version__ = "{self.metadata.version}"'
        self._folder = tempfile.TemporaryDirectory()
        copy = Path(self._folder.name, "__init__.py")
        copy.write_text(re.sub(r"^__version__ = .*$", line, text, flags=re.M), encoding="utf-8")
        build_data["force_include"][str(copy)] = "fishd/__init__.py"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the copy."""
        if version != "editable":
            self._folder.cleanup()

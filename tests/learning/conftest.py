"""Without the extra 'learn', only tests that do not need it are collected."""

from importlib.util import find_spec
from pathlib import Path

EXTRA = ("gymnasium", "joblib", "onnx", "onnxruntime", "stable_baselines3", "tensorboard", "torch")
MISSING = [name for name in EXTRA if find_spec(name) is None]
WITHOUT = ("test_comparison.py", "test_learning_settings.py")


def pytest_report_header() -> str | None:
    return f"tests/learning: most are left out, without {', '.join(MISSING)}" if MISSING else None


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    is_test = collection_path.name.startswith("test_")
    return True if MISSING and is_test and collection_path.name not in WITHOUT else None

"""The forms of a page, made from the verbs of the command line."""

import importlib.util
from contextlib import nullcontext

import msgspec
import pytest

from fishd.cli.experiment_options import RUN_ONLY_OPTIONS
from fishd.cli.forms import describe_forms
from fishd.cli.main import VERBS
from fishd.core.experiments import Form
from fishd.window.job_options import make_options

FORBIDDEN_OPTIONS = {
    *RUN_ONLY_OPTIONS,
    "--config",
    "--set",
    "--to",
    "--jobs",
    "--seeds",
    "--settings",
} - {"--on"}
"""Options that no page may give: other files, other fish, any number of processes."""


def forms() -> dict[str, Form]:
    return {form.kind: form for form in describe_forms()}


def test_each_experiment_of_the_command_line_has_a_form() -> None:
    assert {*VERBS["Experiment"], "learn"} - {"optimum", "queue", *forms()} == set()


def test_a_form_offers_no_file_no_other_fish_and_no_number_of_processes() -> None:
    offered = {field.option for form in forms().values() for field in form.fields}
    assert {"--for", "--budget", "--seed", "--note", "--fit", "--on"} <= offered
    assert offered & FORBIDDEN_OPTIONS == set()


def test_a_field_has_kind_bounds_default_and_help_of_its_option() -> None:
    adapt = {field.name: field for field in forms()["adapt"].fields}
    budget = adapt["budget"]
    assert (budget.kind, budget.low, budget.high, budget.default) == ("number", 150, 3600, 300)
    assert budget.description.startswith("Largest tank time")
    assert (adapt["no_command"].on, adapt["no_command"].initial) == ("live", True)
    assert all(field.description for form in forms().values() for field in form.fields)


def test_the_help_of_a_field_speaks_of_no_command_line() -> None:
    helps = [field.description for form in forms().values() for field in form.fields]
    helps += [form.about for form in forms().values()]
    assert [text for text in helps if "--" in text or "Ctrl-C" in text] == []


@pytest.mark.parametrize(
    ("run", "is_valid"),
    [("größer 2.mcap", True), ("-x", False), ("../x", False), ("~x", False), ("x\n", False)],
)
def test_a_run_of_any_language_is_an_argument_and_nothing_else_is(run: str, is_valid: bool) -> None:
    options = make_options(forms()["rerun"])
    with nullcontext() if is_valid else pytest.raises(msgspec.ValidationError):
        msgspec.convert({"run": run}, options)


def test_a_form_says_which_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "fishd.cli.verbs.find_spec", lambda name: None if name == "torch" else find(name)
    )
    assert "torch is not installed; install it with:" in forms()["learn"].problem
    assert "torch" in forms()["adapt"].problem
    assert forms()["measure"].problem == ""

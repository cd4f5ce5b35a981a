"""Every controller that fishd lists is started from the page, in a true browser."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import expect
from rigs.browser import needs_browser, shared_browser
from rigs.live_page import live_page, start
from rigs.processes import Daemon, install, running
from rigs.window_process import WindowProcess

pytestmark = needs_browser

MODULE = '''
"""A controller that has no default for anything."""

from typing import Annotated, Literal

from fishd.controllers.base import Controller
from fishd.core.schema import note, unit
from msgspec import Struct


class Parameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    side: Annotated[float, unit("rad", "Angle to hold.", ge=0, le=0.3)]
    beats: Annotated[int, unit("1", "Number of beats.", ge=1, le=9)]
    start: Annotated[Literal["left", "right"], note("Side of the first beat.")]
    table: Annotated[str, unit("1", "Table of angles.", file=".csv")]
    mirror: Annotated[bool, note("Whether the table is for the other side.")]


class Demanding(Controller[Parameters]):
    """Hold an angle."""

    Parameters = Parameters

    def update(self, observation):
        return self.parameters.side
'''
NEEDED = {"target": "0.01", "side": "0,2", "beats": "3", "table": "/angles.csv"}
"""Values of required parameters that are typed."""
CHOSEN = {"policy": "default-fish", "start": "right", "mirror": "no"}
"""Those that are chosen from a list."""


@pytest.fixture(scope="module", autouse=True)
def browser() -> Iterator[None]:
    """Open one browser for the pages of this module."""
    with shared_browser():
        yield


@pytest.fixture(scope="module")
def shared_daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """Run a daemon on a machine with a controller of another package."""
    folder = tmp_path_factory.mktemp("daemon")
    install(folder / "site", {"demanding": MODULE}, demanding="demanding:Demanding")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder / "site"), prepend=os.pathsep)
        with running(folder) as daemon:
            yield daemon


def test_every_controller_that_is_listed_can_be_started(
    free_window: WindowProcess, daemon: Daemon
) -> None:
    with live_page(free_window.url) as (page, complaints):
        listed = page.locator("#controller option").all_inner_texts()
        assert {"hold", "square", "swing", "thrust", "ppo", "remote", "demanding"} <= set(listed)
        for name in listed:
            page.select_option("#controller", name)
            expect(page.locator("#start")).to_contain_text(name)
            for parameter, value in {**NEEDED, **CHOSEN}.items():
                field = page.locator(f"#parameter-{parameter}")
                if field.count() and not field.input_value():
                    expect(page.locator("#start")).to_be_disabled()
                    if parameter in CHOSEN:
                        field.select_option(value)
                    else:
                        field.fill(value)
                        field.blur()
            start(page)
            expect(page.locator("#start")).to_have_text(f"Restart {name}")
            if name == "demanding":
                wanted = {"side": 0.2, "beats": 3, "start": "right", "mirror": False}
                assert daemon.status().parameters == {**wanted, "table": "/angles.csv"}
        assert complaints == []


def test_policies_are_a_list_with_their_cards_and_why_one_cannot_swim_here(
    free_window: WindowProcess, tmp_path: Path
) -> None:
    with live_page(free_window.url) as (page, _):
        page.select_option("#controller", "ppo")
        page.select_option("#parameter-policy", "default-fish")
        card = page.locator(".policy")
        expect(card).to_contain_text("% of the best square wave of its fish")
        expect(card).to_contain_text("simulated fish near ω₀ = 12.5 rad/s")
        page.select_option("#parameter-policy", "another file …")
        page.fill("#parameter-policy", str(tmp_path / "none.onnx"))
        page.locator("#parameter-policy").blur()
        page.click("#start")
        expect(page.locator(".notice.error")).to_contain_text("none.onnx")

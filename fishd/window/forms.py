"""Forms of the experiments: read from the command line, which also checks what is entered."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from msgspec import Struct

from fishd.core.decoding import decoder
from fishd.core.experiments import Form, Plan
from fishd.window.children import JobError, call_json
from fishd.window.job_options import list_words, make_options, plan_without_verb

PLAN_TIMEOUT_S = 60.0
"""Longest time for the check of an experiment by its verb [s]."""
_decode_forms: Callable[[bytes], list[Form]] = decoder(list[Form])
_decode_plan: Callable[[bytes], Plan] = decoder(Plan)


class KnownForm(NamedTuple):
    """A form, and the struct of its options."""

    form: Form
    options: type[Struct]


class Forms:
    """The forms of a window; use it in one event loop."""

    def __init__(self, runs: Path) -> None:
        """runs: folder of recordings and experiments"""
        self._runs = runs
        self._known: dict[str, KnownForm] = {}
        self._reading, self._planning = asyncio.Lock(), asyncio.Lock()

    async def all(self) -> dict[str, KnownForm]:
        """Return the forms by their kinds; raise `JobError`."""
        async with self._reading:
            if not self._known:
                forms = await call_json(["window", "forms", "--json"], self._runs, _decode_forms)
                self._known = {form.kind: KnownForm(form, make_options(form)) for form in forms}
        return self._known

    async def plan(self, form: Form, options: Any, endpoint: list[str]) -> Plan | None:
        """Return what an experiment is going to do, as its verb says; raise `JobError`.

        endpoint: options of fishctl for the fish
        One verb is asked at a time.
        """
        if form.problem:
            raise JobError(form.problem)
        if not form.has_plan:
            return plan_without_verb(form, options)
        fish = [f"--on={options.on}", *(endpoint if options.on == "live" else ())]
        words = [*list_words(form, options), *fish, "--dry-run", "--json"]
        try:
            async with self._planning, asyncio.timeout(PLAN_TIMEOUT_S):
                return await call_json(words, self._runs, _decode_plan)
        except TimeoutError:
            raise JobError(f"'fishctl {form.kind}' has not answered") from None

"""The lease of an experiment on the virtual clock: how it ends, and the fish after it."""

from collections.abc import Callable

import pytest
from rigs.harness import Rig

from fishd.control.lease import MAX_STEP_S
from fishd.core.errors import Refused

SECONDS = 2.0


def experiment(rig: Rig, name: str = "measure", seconds: float = SECONDS) -> str:
    """Take the fish and let it swim, as a client does; return the token of the lease."""
    lease = rig.loop.lease.take(name, "lab", 42, seconds)
    rig.start("swing")
    rig.loop.lease.drives = True
    return lease


def expirations(rig: Rig) -> list[str]:
    return [event.message for event in rig.recorder.events if event.kind == "lease-expired"]


def test_a_fish_whose_lease_is_not_renewed_fades_to_neutral_in_time() -> None:
    rig = Rig()
    experiment(rig)
    rig.run_for(SECONDS)
    assert rig.mode == "running"
    ticks = rig.run_for(0.5)
    assert ticks[0].mode == "idle"
    assert ticks[-1].phi_c == 0.0
    message = "measure (pid 42 on lab) has not renewed its lease of the fish for 2 s"
    assert expirations(rig) == [f"{message}: the fish fades to neutral"]
    assert (rig.loop.lease.expired.message, rig.reason) == (message, None)
    assert rig.recorder.kinds()[-2:] == ["lease-expired", "mode"]
    rig.start("swing")  # nothing is latched
    assert rig.run_for(3.0)[-1].mode == "running"


def test_a_fishd_that_stood_still_gives_its_experiment_time_to_renew() -> None:
    rig = Rig()
    lease = experiment(rig)
    rig.run_for(SECONDS - 2.0 * MAX_STEP_S)
    rig.run(missed=200)  # 10 s without a chance to receive a renewal
    assert rig.mode == "running"
    for _ in range(5):
        rig.loop.lease.renew(lease)
        rig.run_for(0.9 * SECONDS)
        assert rig.mode == "running"
    rig.run_for(0.2 * SECONDS)
    assert rig.mode == "idle"


def test_an_experiment_that_computed_beside_a_resting_fish_goes_on_with_its_lease() -> None:
    rig = Rig()
    lease = experiment(rig)
    rig.loop.stop()
    rig.run_for(10.0 * SECONDS)
    assert len(expirations(rig)) == 1
    rig.loop.lease.renew(lease)
    assert rig.loop.lease.active
    rig.start("swing")
    rig.run_for(0.5 * SECONDS)
    rig.loop.lease.renew(lease)
    rig.run_for(2.0 * SECONDS)
    assert rig.mode == "idle"
    with pytest.raises(Refused, match=r"no longer holds the fish: it was not renewed for 2 s"):
        rig.loop.lease.renew(lease)  # the fish swam, so the lease is over


@pytest.mark.parametrize("ran_out", [False, True])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rig: rig.loop.lease.take("optimise", "lab", 43, SECONDS), ""),
        (lambda rig: rig.loop.lease.end("sine was set by hand"), ": sine was set by hand"),
        (lambda rig: rig.loop.estop("enough"), ": estop: enough"),
        (lambda rig: rig.loop.supervisor.fail("servo-link", "no servo"), ": fault: no servo"),
    ],
    ids=["taken", "by hand", "estop", "fault"],
)
def test_a_lease_is_over_once_another_client_has_the_fish_or_a_fault_has_come(
    change: Callable[[Rig], object], words: str, ran_out: bool
) -> None:
    rig = Rig()
    lease = experiment(rig)
    rig.loop.stop()
    rig.run_for((2.0 if ran_out else 0.5) * SECONDS)
    change(rig)
    with pytest.raises(Refused, match=f"no longer holds the fish{words}") as refusal:
        rig.loop.lease.renew(lease)
    assert refusal.value.code == "no-lease"


def test_a_lease_that_ran_out_can_be_renewed_unless_it_was_forgotten() -> None:
    rig = Rig()
    lease = experiment(rig)
    rig.loop.stop()
    rig.run_for(2.0 * SECONDS)
    rig.loop.lease.forget("that of another experiment")
    rig.loop.lease.renew(lease)
    rig.run_for(2.0 * SECONDS)
    rig.loop.lease.forget(lease)
    with pytest.raises(Refused, match="no longer holds the fish"):
        rig.loop.lease.renew(lease)


def test_a_second_experiment_is_refused_with_the_holder_and_its_time() -> None:
    rig = Rig()
    lease = experiment(rig, seconds=60.0)
    rig.run_for(12.0)
    with pytest.raises(Refused, match=r"taken, for 12 s: by measure \(pid 42 on lab\)") as refusal:
        rig.loop.lease.check_free()
    assert refusal.value.code == "leased"
    rig.loop.lease.check_free(lease)


def test_what_swam_by_hand_swims_on_when_a_lease_ends_that_changed_nothing() -> None:
    rig = Rig().start("sine")
    rig.loop.lease.take("measure", "lab", 42, SECONDS)
    assert rig.run_for(2.0 * SECONDS)[-1].controller == "sine"
    assert len(expirations(rig)) == 1

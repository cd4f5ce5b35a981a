"""The hook `rehearse`: the controller in command warms up just before a tick, and harms nothing."""

from harness import Rig, Scripted

from fishd.signals import Observation


class Rehearsing(Scripted):
    """A controller that counts its rehearsals, and can be told to fail in one."""

    def __init__(self) -> None:
        super().__init__(self._steady)
        self.rehearsed = 0
        self.broken = False

    @staticmethod
    def _steady(_: Observation) -> float:
        return 0.1

    def rehearse(self) -> None:
        if self.broken:
            raise RuntimeError("no music")
        self.rehearsed += 1


def test_the_controller_in_command_is_rehearsed_and_the_angle_stays() -> None:
    rig, controller = Rig(), Rehearsing()
    rig.loop.rehearse()  # hold has nothing to rehearse
    rig.start(controller)
    rig.run()
    rig.loop.rehearse()
    assert (controller.rehearsed, rig.loop.applied, rig.loop.seq) == (1, 0.1, 1)


def test_a_rehearsal_that_fails_is_a_fault_of_the_controller() -> None:
    rig, controller = Rig(), Rehearsing()
    rig.start(controller)
    rig.run()
    controller.broken = True
    rig.loop.rehearse()
    assert (rig.mode, rig.reason) == ("fault", "controller-error")
    assert rig.loop.supervisor.reason
    assert "controller rehearsing failed: RuntimeError: no music" in (
        rig.loop.supervisor.reason.message
    )
    assert rig.run(20)[-1].phi_c == 0.0

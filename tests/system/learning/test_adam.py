"""Adam without the compiler of torch."""

import subprocess
import sys

import torch

from fishd.learning.ppo import BETAS, EPSILON, Adam


def parameters() -> list[torch.nn.Parameter]:
    torch.manual_seed(0)
    return [torch.nn.Parameter(torch.randn(shape)) for shape in ((4, 3), (4,), (2,))]


def test_the_results_equal_those_of_the_optimiser_of_torch_also_from_its_state() -> None:
    ours, theirs = parameters(), parameters()
    optimiser = Adam(ours, lr=0.01)
    reference = torch.optim.Adam(theirs, lr=0.01, betas=BETAS, eps=EPSILON)
    for step in range(6):
        for learned, one in ((ours, optimiser), (theirs, reference)):
            one.zero_grad()
            loss = sum((p**4).sum() for p in learned[:2])  # the last has no gradient
            loss.backward()  # type: ignore[union-attr]
            one.step()
        if step == 2:
            optimiser = Adam(ours, lr=0.5)
            optimiser.load_state_dict(reference.state_dict())
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other)
    assert optimiser.state_dict()["state"].keys() == reference.state_dict()["state"].keys()


def test_a_training_loads_no_compiler() -> None:
    code = (
        "import sys, torch; from fishd.learning.ppo import make_policy; "
        "from fishd.learning.settings import PpoSettings; policy = make_policy(PpoSettings(), 3); "
        "policy.predict_values(torch.zeros(1, 3)).sum().backward(); policy.optimizer.step(); "
        "sys.exit('torch._dynamo' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)

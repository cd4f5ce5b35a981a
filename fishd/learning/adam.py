"""Adam as torch computes it, without `torch.optim.Optimizer`.

That class imports torch's compiler, which is not used here and takes a second.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch.optim.adam import adam

BETAS = 0.9, 0.999
EPSILON = 1e-5
"""Smallest denominator, as in stable-baselines3."""


class Adam:
    """An optimiser with the methods stable-baselines3 uses, and the state of `torch.optim.Adam`."""

    def __init__(self, parameters: Iterable[torch.Tensor], lr: float) -> None:
        self.param_groups: list[dict[str, Any]] = [{"params": list(parameters), "lr": lr}]
        self._state: dict[int, dict[str, torch.Tensor]] = {}

    def zero_grad(self) -> None:
        """Delete the gradients."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Change the parameters that have gradients."""
        learned = {k: p for k, p in enumerate(self._parameters) if p.grad is not None}
        for index, parameter in learned.items():
            if index not in self._state:
                self._state[index] = {
                    "step": torch.tensor(0.0),
                    "exp_avg": torch.zeros_like(parameter),
                    "exp_avg_sq": torch.zeros_like(parameter),
                }
        states = [self._state[index] for index in learned]
        adam(
            list(learned.values()),
            [parameter.grad for parameter in learned.values() if parameter.grad is not None],
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [],
            [state["step"] for state in states],
            fused=True,
            amsgrad=False,
            beta1=BETAS[0],
            beta2=BETAS[1],
            lr=self.param_groups[0]["lr"],
            weight_decay=0.0,
            eps=EPSILON,
            maximize=False,
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a checkpoint stores."""
        (group,) = self.param_groups
        numbers = list(range(len(group["params"])))
        return {"state": self._state, "param_groups": [{**group, "params": numbers}]}

    def load_state_dict(self, state: dict[str, Any], strict: bool = True) -> None:
        """Load the state from a checkpoint.

        strict: ignored; stable-baselines3 passes it

        Raises ValueError where the shapes are those of other parameters.
        """
        parameters = self._parameters
        taken = {
            index: {name: value.clone() for name, value in moments.items()}
            for index, moments in state["state"].items()
        }
        for index, moments in taken.items():
            if moments["exp_avg"].shape != parameters[index].shape:
                raise ValueError("the state of the optimiser does not fit the networks")
        self._state = taken
        self.param_groups[0]["lr"] = state["param_groups"][0]["lr"]

    @property
    def _parameters(self) -> list[torch.Tensor]:
        parameters: list[torch.Tensor] = self.param_groups[0]["params"]
        return parameters

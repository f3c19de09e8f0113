"""Optimisers with their state in shared memory, against formulas and torch's own."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from torchrl_hmcts.trainers import SharedRMSprop
from torchrl_hmcts.trainers.a3c.shared_optimizers import share_optimizer

GRADIENTS = [[2.0, -1.0], [0.5, 0.0], [-4.0, 1e-3]]


def step_through(optimizer: Optimizer, parameter: nn.Parameter) -> list[Tensor]:
    values = []
    for gradient in GRADIENTS:
        parameter.grad = torch.tensor(gradient)
        optimizer.step()
        values.append(parameter.detach().clone())
    return values


def test_rmsprop_is_the_papers_formula_with_epsilon_under_the_root() -> None:
    parameter = nn.Parameter(torch.tensor([1.0, 2.0]))
    optimizer = SharedRMSprop([parameter], lr=0.1, alpha=0.9, eps=1e-2, weight_decay=0.5)
    theta, mean = [1.0, 2.0], [0.0, 0.0]
    for value, gradient in zip(step_through(optimizer, parameter), GRADIENTS, strict=True):
        for i in range(2):
            g = gradient[i] + 0.5 * theta[i]
            mean[i] = 0.9 * mean[i] + 0.1 * g * g
            theta[i] -= 0.1 * g / math.sqrt(mean[i] + 1e-2)
        assert value.tolist() == pytest.approx(theta, rel=1e-5)


@pytest.mark.parametrize(
    "make",
    [
        lambda p: torch.optim.Adam(p, lr=0.1, weight_decay=0.3, amsgrad=True, fused=True),
        lambda p: torch.optim.Adam(p, lr=0.1, amsgrad=True),
        lambda p: torch.optim.Adagrad(p, lr=0.1, initial_accumulator_value=0.5),
        lambda p: torch.optim.Adamax(p, lr=0.1),
        lambda p: torch.optim.AdamW(p, lr=0.1, weight_decay=0.1),
        lambda p: torch.optim.RMSprop(p, lr=0.1, momentum=0.5, centered=True, weight_decay=0.2),
        lambda p: torch.optim.SGD(p, lr=0.1, momentum=0.9, nesterov=True, weight_decay=0.2),
        lambda p: torch.optim.SGD(p, lr=0.1),
    ],
)
def test_a_shared_optimiser_steps_as_one_that_is_not(
    make: Callable[[list[nn.Parameter]], Optimizer],
) -> None:
    mine, theirs = (nn.Parameter(torch.tensor([1.0, 2.0])) for _ in range(2))
    shared = share_optimizer(make([mine]))
    assert mine.tolist() == [1.0, 2.0]
    assert mine.grad is None
    entries = [e for e in shared.state[mine].values() if isinstance(e, Tensor)]
    assert mine.is_shared()
    assert all(entry.is_shared() for entry in entries)
    actual, expected = step_through(shared, mine), step_through(make([theirs]), theirs)
    assert all(torch.equal(a, b) for a, b in zip(actual, expected, strict=True))


def test_a_parameter_without_gradient_stays() -> None:
    parameters = [nn.Parameter(torch.ones(1)) for _ in range(2)]
    optimizer = SharedRMSprop(parameters, lr=0.1)
    parameters[0].grad = torch.ones(1)
    optimizer.step()
    assert parameters[0].item() < 1.0
    assert parameters[1].item() == 1.0


def test_a_closure_is_called_with_gradients() -> None:
    parameter = nn.Parameter(torch.ones(1))
    optimizer = SharedRMSprop([parameter], lr=0.1)

    def closure() -> float:
        loss = parameter.square().sum()
        loss.backward()
        return loss.item()

    assert optimizer.step(closure) == 1.0
    assert parameter.item() < 1.0


def test_an_optimiser_whose_state_cannot_be_built_beforehand_is_refused() -> None:
    with pytest.raises(TypeError, match="NAdam builds its state at its first step.*SharedRMSprop"):
        share_optimizer(torch.optim.NAdam([nn.Parameter(torch.ones(1))]))


def test_parameters_that_are_not_in_the_cpus_memory_are_refused() -> None:
    parameter = nn.Parameter(torch.ones(1, device="meta"))
    with pytest.raises(ValueError, match=r"these are on \{'meta'\}.*to\('cpu'\)"):
        SharedRMSprop([parameter])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"lr": -1.0}, "lr >= 0.0.*; got -1.0"),
        ({"alpha": 1.0}, "alpha < 1.*1.0"),
        ({"eps": 0.0}, "eps > 0.*0.0"),
        ({"weight_decay": -1.0}, "weight_decay >= 0.0.*; got -1.0"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SharedRMSprop([nn.Parameter(torch.ones(1))], **settings)

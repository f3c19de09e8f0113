"""Optimisers whose state lies in shared memory, for processes that step them without a lock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from torchrl_hmcts.checks import real_number
from torchrl_hmcts.processes import share

# Those whose state after a step with zero gradients is the state they start from.
_SHAREABLE = ("Adagrad", "Adam", "Adamax", "AdamW", "RMSprop", "SGD", "SharedRMSprop")
_LARGEST = torch.finfo(torch.float32).max


def share_optimizer(optimizer: Optimizer) -> Optimizer:
    """Build an optimiser's state at once, and move it and the parameters to shared memory.

    torch builds the state at the first step, so that each process would get one of its own. Here
    parameters and state stay what they were, but every process that receives the optimiser changes
    the same numbers when it steps. Learning rates and other settings stay each process's own.
    """
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    elsewhere = {str(p.device) for p in parameters if p.device.type != "cpu"}
    if elsewhere:
        raise ValueError(
            f"Learners share their parameters in the CPU's memory; these are on {elsewhere}. "
            "Move the networks with .to('cpu') before building the optimiser."
        )
    if any(not optimizer.state.get(p) for p in parameters):
        _build_state(optimizer, parameters)
    states = [entry for p in parameters for entry in optimizer.state[p].values()]
    share([*parameters, *(s for s in states if isinstance(s, Tensor))], type(optimizer).__name__)
    return optimizer


def _build_state(optimizer: Optimizer, parameters: list[Tensor]) -> None:
    if not any(kind.__name__ in _SHAREABLE for kind in type(optimizer).__mro__):
        raise TypeError(
            f"{type(optimizer).__name__} builds its state at its first step, so each learner would "
            f"have its own. Use one of {', '.join(_SHAREABLE)}."
        )
    before = [p.detach().clone() for p in parameters]
    decay = [group.get("weight_decay", 0.0) for group in optimizer.param_groups]
    for group in optimizer.param_groups:
        group["weight_decay"] = 0.0
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    with torch.no_grad():
        for parameter, value in zip(parameters, before, strict=True):
            parameter.copy_(value)
            parameter.grad = None
            for name, entry in optimizer.state[parameter].items():
                if name == "step":
                    entry.zero_()
    for group, value in zip(optimizer.param_groups, decay, strict=True):
        group["weight_decay"] = value


class SharedRMSprop(Optimizer):
    r"""RMSprop with one shared mean of squared gradients, as in A3C.

    .. math::

        g \leftarrow \alpha g + (1 - \alpha)\, \Delta\theta^2, \qquad
        \theta \leftarrow \theta - \eta\, \Delta\theta / \sqrt{g + \epsilon}

    Unlike ``torch.optim.RMSprop`` it has :math:`\epsilon` under the root. Processes that step it at
    the same time may overwrite each other's share of :math:`g`, which the paper accepts.

    Args:
        params (iterable): parameters, or groups of them; moved to shared memory.
        lr, alpha (float): :math:`\eta`, and the memory of the mean, in ``[0, 1)``, the paper's.
        eps (float): :math:`\epsilon > 0`, in units of squared gradients; the paper's 0.1 goes with
            gradients summed over a segment.
        weight_decay (float): added to the gradient times the parameter.

    Raises:
        TypeError: if ``params`` is no list of parameters, or a setting is no number.
        ValueError: if a setting is out of range.

    Reference:
        Mnih et al., "Asynchronous methods for deep reinforcement learning", 2016, arXiv 1602.01783,
        section 4.

    Examples:
        >>> weight = torch.nn.Parameter(torch.tensor([1.0]))
        >>> optimizer = SharedRMSprop([weight], lr=0.1, alpha=0.75, eps=1e-8)
        >>> weight.grad = torch.tensor([2.0])
        >>> optimizer.step()
        >>> weight.item(), optimizer.state[weight]["square_avg"].item()
        (0.800000011920929, 1.0)
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 7e-4,
        alpha: float = 0.99,
        eps: float = 1e-5,
        weight_decay: float = 0.0,
    ) -> None:
        for name, value in (("lr", lr), ("weight_decay", weight_decay)):
            real_number("SharedRMSprop", name, value, least=0.0, most=_LARGEST)
        if real_number("SharedRMSprop", "alpha", alpha, least=0.0) >= 1.0:
            raise ValueError(f"SharedRMSprop needs alpha < 1, its memory; got {alpha}.")
        real_number("SharedRMSprop", "eps", eps, above=0.0, most=_LARGEST)
        try:
            groups = list(params)
        except (RuntimeError, TypeError) as error:
            raise TypeError(
                f"SharedRMSprop needs a list of parameters for params; got a "
                f"{type(params).__name__}."
            ) from error
        super().__init__(
            groups, {"lr": lr, "alpha": alpha, "eps": eps, "weight_decay": weight_decay}
        )
        share_optimizer(self)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """Changes the parameters by their gradients."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            alpha, decay = group["alpha"], group["weight_decay"]
            for parameter in group["params"]:
                gradient = parameter.grad
                if gradient is None:
                    continue
                if decay:
                    gradient = gradient.add(parameter, alpha=decay)
                state = self.state[parameter]
                if not state:
                    state["square_avg"] = torch.zeros_like(parameter)
                mean = state["square_avg"]
                mean.mul_(alpha).addcmul_(gradient, gradient, value=1.0 - alpha)
                # The mean is read once: another process may be writing it.
                parameter.addcdiv_(gradient, (mean + group["eps"]).sqrt_(), value=-group["lr"])
        return loss


def share_over(optimizer: Optimizer, parameters: list[nn.Parameter]) -> Optimizer:
    """Share an optimiser over parameters of a loss; its groups know their first lr."""
    known = {id(p) for p in parameters}
    held = [p for group in optimizer.param_groups for p in group["params"]]
    foreign = sum(id(p) not in known for p in held)
    if foreign:
        raise ValueError(
            f"{foreign} of the optimiser's {len(held)} parameters are not the loss's. Build it "
            "over loss_module.parameters()."
        )
    for group in share_optimizer(optimizer).param_groups:
        group.setdefault("initial_lr", group["lr"])
    return optimizer


class OptimizerState:
    """An optimiser's state and settings, which stay in shared memory when they are loaded."""

    def __init__(self, optimizer: Optimizer) -> None:
        self.optimizer = optimizer

    def state_dict(self) -> dict[str, Any]:
        return self.optimizer.state_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        saved, own = (
            sorted({key for entry in state["state"].values() for key in entry})
            for state in (state_dict, self.optimizer.state_dict())
        )
        if saved != own:
            raise ValueError(
                f"the checkpoint's optimiser has the state {saved}, this one, "
                f"{type(self.optimizer).__name__}, has {own}. Continue with the same optimiser."
            )
        self.optimizer.load_state_dict(dict(state_dict))
        share_optimizer(self.optimizer)  # loading has put new tensors in place of the shared ones

"""The option-critic's termination gradient, and the values of options it needs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives.utils import distance_loss

from torchrl_hmcts.checks import one_of, real_number
from torchrl_hmcts.objectives.loss import DISTANCES, Loss, run_module, without_terminal_entries

OptionPolicy = Callable[[TensorDictBase], Tensor]


class _OptionLoss(Loss):
    """The common part of both losses: transitions of an option, and its values where they lead."""

    @dataclass
    class _AcceptedKeys(Loss._AcceptedKeys):
        skill: NestedKey = "skill"
        termination_logits: NestedKey = "termination_logits"
        action_value: NestedKey = "action_value"
        terminated: NestedKey = "terminated"

    def _features(self, *modules: Any) -> list[NestedKey]:
        """Returns what modules read besides the option."""
        keys = [unravel_key(key) for module in modules for key in getattr(module, "in_keys", ())]
        return [key for key in keys if key != unravel_key(self.tensor_keys.skill)]

    def _next_with_option(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns what follows, with the option that led there; zeros where it terminated."""
        keys, after = self.tensor_keys, tensordict.get("next")
        reward = unravel_key(getattr(keys, "reward", ""))
        read = [key for key in after.keys(True, True) if key != reward]
        after = without_terminal_entries(after, after.get(keys.terminated), read)
        return after.set(keys.skill, tensordict.get(keys.skill))

    def _of_option(self, values: Tensor, option: Tensor) -> Tensor:
        """Returns the value of each option ``[*B]`` among those of all ``[*B, A]``."""
        if values.shape[:-1] != option.shape:
            raise ValueError(
                f"{type(self).__name__} needs action values [*B, A] and options [*B]; got "
                f"{list(values.shape)} and {list(option.shape)}. One-hot options become indices by "
                "option.long().argmax(-1)."
            )
        return values.gather(-1, option.unsqueeze(-1)).squeeze(-1)


class OptionTerminationLoss(_OptionLoss):
    r"""The termination gradient: ends an option where the value of another is larger.

    .. math::

        L(\phi) = (1 - d)\, \beta_\phi(s', o)\, \bigl[A(s', o) + \xi\bigr], \qquad
        A(s', o) = Q_\Omega(s', o) - V_\Omega(s')

    with the advantage detached, so that :math:`-\nabla L` is the gradient of the expected return by
    the termination's parameters. :math:`V_\Omega(s') = \max_o Q_\Omega(s', o)`, or the mean over a
    policy's options. With the deliberation cost :math:`\xi` an option ends only where continuing
    costs more than that. A transition is one base step (or several) of an option.

    Args:
        termination_network (TensorDictModuleBase): writes ``termination_logits`` ``[*B, 1]`` from
            entries of the next state and the option ``skill``, e.g. a
            :class:`~torchrl_hmcts.modules.TerminationNetwork`.
        qvalue_network (TensorDictModuleBase, optional): writes ``action_value`` ``[*B, A]`` from
            entries of the next state; read as it is at every call, its owner's. Default: ``("next",
            action_value)`` of the data.
        deliberation_cost (float): :math:`\xi \ge 0`, in units of return. Default 0.
        option_policy (callable, optional): ``option_policy(td) -> probabilities [*B, A]`` in the
            next state, e.g. a :class:`~torchrl_hmcts.planners.ModulePrior`. Default: the best.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_termination`` and the detached ``termination_probability`` and
        ``option_advantage``; with ``reduction="none"`` all ``[*B]``.

    Raises:
        ValueError: at the call if a shape does not fit.

    Keys (``set_keys``): ``skill`` (the option, int64 ``[*B]``), ``termination_logits``,
    ``action_value``, ``terminated`` (:math:`d`), ``priority_weight``.

    Reference:
        Bacon, Harb and Precup, "The option-critic architecture", 2017, arXiv 1609.05140, theorem 2;
        Harb et al., "When waiting is not an option", 2018, arXiv 1709.04571 (deliberation cost).

    Examples:
        >>> from torchrl_hmcts.modules import TerminationNetwork
        >>> from torchrl_hmcts.objectives import OptionTerminationLoss
        >>> OptionTerminationLoss(TerminationNetwork(2, 3, in_keys=["velocity"])).in_keys
        ['skill', ('next', 'velocity'), ('next', 'action_value'), ('next', 'terminated')]
    """

    out_keys = ["loss_termination", "termination_probability", "option_advantage"]

    termination_network: TensorDictModuleBase
    termination_network_params: TensorDictParams
    target_termination_network_params: TensorDictParams

    def __init__(
        self,
        termination_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase | None = None,
        *,
        deliberation_cost: float = 0.0,
        option_policy: OptionPolicy | None = None,
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction)
        cost = real_number(type(self).__name__, "deliberation_cost", deliberation_cost, least=0.0)
        self.convert_to_functional(
            termination_network, "termination_network", create_target_params=False
        )
        # Not sub-modules: they are read, and belong to whoever trains them.
        self.__dict__["qvalue_network"] = qvalue_network
        self.__dict__["option_policy"] = option_policy
        self.register_buffer("deliberation_cost", torch.tensor(cost))

    def _reads(self) -> Iterable[NestedKey]:
        keys = self.tensor_keys
        read = self._features(self.termination_network, self.qvalue_network)
        if self.qvalue_network is None:
            read.append(keys.action_value)
        read += [keys.terminated, *getattr(self.option_policy, "in_keys", ())]
        return [keys.skill, *(("next", key) for key in read)]

    @torch.no_grad()
    def advantage(self, tensordict: TensorDictBase) -> Tensor:
        """Returns A(s', o) of transitions ``[*B]``: how much worse than V(s') it is to continue."""
        next_td = self._next_with_option(tensordict)
        if self.qvalue_network is not None:
            self.qvalue_network(next_td)
        values = next_td.get(self.tensor_keys.action_value)  # [*B, A]
        own = self._of_option(values, tensordict.get(self.tensor_keys.skill))
        if self.option_policy is None:
            return own - values.amax(-1)
        return own - (self.option_policy(next_td) * values).sum(-1)

    def termination_probability(self, tensordict: TensorDictBase) -> Tensor:
        """Returns beta(s', o) of transitions ``[*B]``, with gradients."""
        network, params = self.termination_network, self.termination_network_params
        out = run_module(network, params, self._next_with_option(tensordict))
        return out.get(self.tensor_keys.termination_logits).sigmoid().reshape(tensordict.batch_size)

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        advantage = self.advantage(tensordict)
        probability = self.termination_probability(tensordict)
        runs = ~tensordict.get(unravel_key(("next", self.tensor_keys.terminated)))
        loss = probability * (advantage + self.deliberation_cost) * runs.reshape(advantage.shape)
        return {
            "loss_termination": self._reduce(loss, tensordict),
            "termination_probability": self._average(probability),
            "option_advantage": self._average(advantage),
        }


class IntraOptionQLoss(_OptionLoss):
    r"""Learns values of options that end with a learned probability, from any piece of an option.

    .. math::

        L(\theta) &= \ell\bigl(Q_\theta(s, o),\; R + \gamma^k (1 - d)\, U(s', o)\bigr) \\
        U(s', o) &= (1 - \beta(s', o))\, \bar Q(s', o) + \beta(s', o) \max_{o'} \bar Q(s', o')

    A transition is any piece of an option of :math:`k` base steps; data of options that ended
    otherwise serve as well. With :math:`\beta = 1` it is Q-learning on the macro env.

    Args:
        qvalue_network (TensorDictModuleBase): writes ``action_value`` ``[*B, A]``.
        termination_network (TensorDictModuleBase, optional): writes ``termination_logits``; read as
            it is at every call, its owner's. Default: options end (beta = 1).
        gamma (float): discount per base step, in ``(0, 1]``.
        loss_function (str): ``"l2"`` (default), ``"l1"`` or ``"smooth_l1"``.
        delay_value (bool): bootstrap from target parameters, to be moved by ``SoftUpdate``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_qvalue`` and the detached ``td_error`` (absolute); with
        ``reduction="none"`` both ``[*B]``.

    Raises:
        ValueError: at the call if a shape does not fit.

    Keys (``set_keys``): those of :class:`OptionTerminationLoss`, ``reward`` and ``duration``
    (:math:`k`, int64 ``[*B, 1]``, under ``"next"``; 1 where the data have none).

    Reference:
        Sutton, Precup and Singh, "Between MDPs and semi-MDPs", 1999, section 6; Bacon, Harb and
        Precup, "The option-critic architecture", 2017, arXiv 1609.05140, algorithm 1.

    Examples:
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.objectives import IntraOptionQLoss
        >>> values = TensorDictModule(lambda x: x, ["x"], ["action_value"])
        >>> after = TensorDict(x=torch.tensor([[1.0, 8.0]]), reward=torch.ones(1, 1),
        ...                    duration=torch.full((1, 1), 3), terminated=torch.zeros(1, 1).bool())
        >>> td = TensorDict(skill=torch.tensor([0]), next=after, batch_size=[1])
        >>> IntraOptionQLoss(values, gamma=0.5, delay_value=False).target(td)  # 1 + 0.5 ** 3 * 8
        tensor([2.])
    """

    @dataclass
    class _AcceptedKeys(_OptionLoss._AcceptedKeys):
        reward: NestedKey = "reward"
        duration: NestedKey = "duration"

    out_keys = ["loss_qvalue", "td_error"]

    qvalue_network: TensorDictModuleBase
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams

    def __init__(
        self,
        qvalue_network: TensorDictModuleBase,
        termination_network: TensorDictModuleBase | None = None,
        *,
        gamma: float = 0.99,
        loss_function: str = "l2",
        delay_value: bool = True,
        reduction: str = "mean",
    ) -> None:
        super().__init__(reduction)
        owner = type(self).__name__
        gamma = real_number(owner, "gamma", gamma, above=0.0, most=1.0)
        self.loss_function = one_of(owner, "loss_function", loss_function, DISTANCES)
        self.delay_value = delay_value
        self.convert_to_functional(
            qvalue_network, "qvalue_network", create_target_params=delay_value
        )
        self.__dict__["termination_network"] = termination_network  # read only: its owner's
        self.register_buffer("gamma", torch.tensor(gamma))

    def _reads(self) -> Iterable[NestedKey]:
        keys, root = self.tensor_keys, self._features(self.qvalue_network)
        read = [*root, *self._features(self.termination_network)]
        in_next = [("next", key) for key in (*read, keys.reward, keys.terminated, keys.duration)]
        return [keys.skill, *root, *in_next]

    @torch.no_grad()
    def target(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the target of Q(s, o), ``[*B]``."""
        keys, option = self.tensor_keys, tensordict.get(self.tensor_keys.skill)
        next_td = self._next_with_option(tensordict)
        params = self.target_qvalue_network_params  # without a delay those of now, detached
        values = run_module(self.qvalue_network, params, next_td).get(keys.action_value)
        same, value = self._of_option(values, option), values.amax(-1)
        if self.termination_network is not None:
            logits = self.termination_network(next_td).get(keys.termination_logits)
            value = torch.lerp(same, value, logits.sigmoid().reshape(value.shape))
        reward = next_td.get(keys.reward).reshape(value.shape)
        runs = ~next_td.get(keys.terminated).reshape(value.shape)
        duration = next_td.get(keys.duration, None)
        discount = self.gamma if duration is None else self.gamma ** duration.reshape(value.shape)
        return reward + discount * value * runs

    def losses(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        keys, target = self.tensor_keys, self.target(tensordict)
        out = run_module(self.qvalue_network, self.qvalue_network_params, tensordict)
        chosen = self._of_option(out.get(keys.action_value), tensordict.get(keys.skill))
        loss = distance_loss(chosen, target, self.loss_function)
        error = (chosen.detach() - target).abs()
        return {"loss_qvalue": self._reduce(loss, tensordict), "td_error": self._average(error)}

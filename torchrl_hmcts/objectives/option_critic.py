"""The option-critic's termination gradient, and the values of options it needs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss

from torchrl_hmcts.objectives.functional import without_terminal_entries
from torchrl_hmcts.objectives.priority import PriorityWeights
from torchrl_hmcts.objectives.skill_objective import check_reduction

OptionPolicy = Callable[[TensorDictBase], Tensor]


class OptionTerminationLoss(PriorityWeights, LossModule):
    r"""The termination gradient: end an option where another one promises more.

    .. math::

        L(\phi) = (1 - d)\, \beta_\phi(s', o)\, \bigl[A(s', o) + \xi\bigr], \qquad
        A(s', o) = Q_\Omega(s', o) - V_\Omega(s')

    with the advantage detached, so that :math:`-\nabla L` is the gradient of the expected return by
    the termination's parameters (theorem 2 of the paper, for states :math:`s'` met while options
    run). :math:`V_\Omega(s') = \max_o Q_\Omega(s', o)`, or the mean over a policy's options. Where
    o is the best option the advantage is 0: the deliberation cost :math:`\xi` makes it go on there,
    and end only where going on costs more than :math:`\xi`.

    Each transition is one base step (or several) of an option: root and ``"next"``, with the option
    that runs at the root. Where the option values come from is not this loss's business: TorchRL's
    ``DQNLoss`` on a macro env, :class:`IntraOptionQLoss`, or the values of a search tree.

    Args:
        termination_network (TensorDictModuleBase): writes ``termination_logits`` ``[*B, 1]`` from
            entries of the next state and the option ``skill``, e.g. a
            :class:`~torchrl_hmcts.modules.TerminationNetwork`.
        qvalue_network (TensorDictModuleBase, optional): writes ``action_value`` ``[*B, A]`` from
            entries of the next state. It stays its owner's: it is read as it is at every call, and
            neither trained nor saved here. Default: ``("next", action_value)`` of the data.
        deliberation_cost (float): :math:`\xi \ge 0`, in units of return. Default 0.
        option_policy (callable, optional): ``option_policy(td) -> probabilities [*B, A]`` in the
            next state, e.g. a :class:`~torchrl_hmcts.planners.ModulePrior`. Default: the best.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_termination`` and the detached ``termination_probability`` and
        ``option_advantage``; with ``reduction="none"`` all ``[*B]``.

    Raises:
        ValueError: if the deliberation cost is negative or the reduction is unknown; at the call if
            a shape does not fit.

    Keys (``set_keys``): ``skill`` (the option, int64 ``[*B]``, default ``"skill"``),
    ``termination_logits``, ``action_value``, ``terminated`` (:math:`d`, default ``"terminated"``),
    ``priority_weight``.

    Reference:
        Bacon, Harb and Precup, "The option-critic architecture", 2017, arXiv 1609.05140, theorem 2;
        Harb et al., "When waiting is not an option", 2018, arXiv 1709.04571 (deliberation cost).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_hmcts.modules import TerminationNetwork
        >>> from torchrl_hmcts.objectives import OptionTerminationLoss
        >>> loss = OptionTerminationLoss(TerminationNetwork(2, 3, in_keys=["velocity"]))
        >>> td = TensorDict(
        ...     skill=torch.tensor([0, 1]),
        ...     next=TensorDict(velocity=torch.zeros(2, 2), action_value=torch.eye(3)[:2],
        ...                     terminated=torch.zeros(2, 1, dtype=torch.bool), batch_size=[2]),
        ...     batch_size=[2])
        >>> sorted(loss(td).keys())
        ['loss_termination', 'option_advantage', 'termination_probability']
    """

    @dataclass
    class _AcceptedKeys:
        skill: NestedKey = "skill"
        termination_logits: NestedKey = "termination_logits"
        action_value: NestedKey = "action_value"
        terminated: NestedKey = "terminated"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_termination", "termination_probability", "option_advantage"]

    termination_network: TensorDictModuleBase
    termination_network_params: TensorDictParams
    target_termination_network_params: TensorDictParams
    _in_keys: Any  # list of keys, or None until it is known

    def __init__(
        self,
        termination_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase | None = None,
        *,
        deliberation_cost: float = 0.0,
        option_policy: OptionPolicy | None = None,
        reduction: str = "mean",
    ) -> None:
        self._in_keys = None
        super().__init__()
        check_reduction(type(self).__name__, reduction)
        if not (math.isfinite(deliberation_cost) and deliberation_cost >= 0.0):
            raise ValueError(
                f"OptionTerminationLoss needs a deliberation_cost >= 0, what ending an option "
                f"costs in units of return; got {deliberation_cost}."
            )
        self.convert_to_functional(
            termination_network, "termination_network", create_target_params=False
        )
        # Not sub-modules: they are read, and belong to whoever trains them.
        self.__dict__["qvalue_network"] = qvalue_network
        self.__dict__["option_policy"] = option_policy
        self.register_buffer("deliberation_cost", torch.tensor(float(deliberation_cost)))
        self.reduction = reduction

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        own = {unravel_key(keys.skill)}
        read = [key for key in self.termination_network.in_keys if unravel_key(key) not in own]
        if self.qvalue_network is None:
            read.append(keys.action_value)
        else:
            read += [key for key in self.qvalue_network.in_keys if unravel_key(key) not in own]
        read += [keys.terminated, *getattr(self.option_policy, "in_keys", ())]
        in_next = [unravel_key(("next", key)) for key in read]
        self._in_keys = list(dict.fromkeys([unravel_key(keys.skill), *in_next]))

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that ``forward`` reads."""
        if self._in_keys is None:
            self._set_in_keys()
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        self._in_keys = None

    @torch.no_grad()
    def advantage(self, tensordict: TensorDictBase) -> Tensor:
        """Returns A(s', o) of transitions ``[*B]``: how much worse than V(s') going on is."""
        next_td = _next_with_option(tensordict, self.tensor_keys)
        if self.qvalue_network is not None:
            self.qvalue_network(next_td)
        values = next_td.get(self.tensor_keys.action_value)  # [*B, A]
        option = tensordict.get(self.tensor_keys.skill)  # [*B]
        _check_values("OptionTerminationLoss", values, option)
        if self.option_policy is None:
            value = values.amax(-1)
        else:
            value = (self.option_policy(next_td) * values).sum(-1)
        return values.gather(-1, option.unsqueeze(-1)).squeeze(-1) - value

    def termination_probability(self, tensordict: TensorDictBase) -> Tensor:
        """Returns beta(s', o) of transitions ``[*B]``, with gradients."""
        next_td = _next_with_option(tensordict, self.tensor_keys)
        network = self.termination_network
        with self.termination_network_params.to_module(network, preserve_module_state=False):
            logits = network(next_td).get(self.tensor_keys.termination_logits)
        return logits.sigmoid().reshape(tensordict.batch_size)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        advantage = self.advantage(tensordict)
        probability = self.termination_probability(tensordict)
        runs = ~tensordict.get(unravel_key(("next", self.tensor_keys.terminated)))
        runs = runs.reshape(tensordict.batch_size)
        loss = probability * (advantage + self.deliberation_cost) * runs
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(loss, tensordict=tensordict, weights=weights)
        probability = probability.detach()
        if self.reduction != "none":
            probability, advantage = probability.mean(), advantage.mean()
        out = TensorDict(
            {
                "loss_termination": loss,
                "termination_probability": probability,
                "option_advantage": advantage,
            },
            batch_size=tensordict.batch_size if self.reduction == "none" else [],
        )
        self._clear_weakrefs(tensordict, out, "termination_network_params")
        return out


class IntraOptionQLoss(PriorityWeights, LossModule):
    r"""Values of options that end with a learned probability, from parts of their way.

    .. math::

        L(\theta) &= \ell\bigl(Q_\theta(s, o),\; R + \gamma^k (1 - d)\, U(s', o)\bigr) \\
        U(s', o) &= (1 - \beta(s', o))\, \bar Q(s', o) + \beta(s', o) \max_{o'} \bar Q(s', o')

    A transition is any piece of an option of :math:`k` base steps, one of them or all: what the
    option would have done afterwards is :math:`\beta`'s to say, so that data of options that ended
    otherwise serve as well. With :math:`\beta = 1` it is Q-learning on the macro env.

    Args:
        qvalue_network (TensorDictModuleBase): writes ``action_value`` ``[*B, A]``.
        termination_network (TensorDictModuleBase, optional): writes ``termination_logits``. It
            stays its owner's, and is read as it is at every call. Default: options end (beta = 1).
        gamma (float): discount per base step, in ``(0, 1]``. Default 0.99.
        loss_function (str): ``"l2"`` (default), ``"l1"`` or ``"smooth_l1"``.
        delay_value (bool): bootstrap from target parameters, to be moved by ``SoftUpdate``. Default
            ``True``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Returns:
        TensorDict with ``loss_qvalue`` and the detached ``td_error`` (absolute); with
        ``reduction="none"`` both ``[*B]``.

    Raises:
        ValueError: if ``gamma`` or the reduction is out of range; at the call if a shape does not
            fit.

    Keys (``set_keys``): ``skill`` (the option), ``termination_logits``, ``action_value``,
    ``reward``, ``terminated``, ``duration`` (:math:`k`, int64 ``[*B, 1]``, under ``"next"``; 1
    where the data have none), ``priority_weight``.

    Reference:
        Sutton, Precup and Singh, "Between MDPs and semi-MDPs", 1999, section 6; Bacon, Harb and
        Precup, "The option-critic architecture", 2017, arXiv 1609.05140, algorithm 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_hmcts.objectives import IntraOptionQLoss
        >>> network = TensorDictModule(torch.nn.Linear(2, 3), ["velocity"], ["action_value"])
        >>> loss = IntraOptionQLoss(network, delay_value=False)
        >>> td = TensorDict(
        ...     velocity=torch.zeros(2, 2), skill=torch.tensor([0, 1]),
        ...     next=TensorDict(velocity=torch.zeros(2, 2), reward=torch.ones(2, 1),
        ...                     duration=torch.full((2, 1), 5),
        ...                     terminated=torch.zeros(2, 1, dtype=torch.bool), batch_size=[2]),
        ...     batch_size=[2])
        >>> sorted(loss(td).keys())
        ['loss_qvalue', 'td_error']
    """

    @dataclass
    class _AcceptedKeys:
        skill: NestedKey = "skill"
        termination_logits: NestedKey = "termination_logits"
        action_value: NestedKey = "action_value"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        duration: NestedKey = "duration"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_qvalue", "td_error"]

    qvalue_network: TensorDictModuleBase
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams
    _in_keys: Any  # list of keys, or None until it is known

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
        self._in_keys = None
        super().__init__()
        check_reduction(type(self).__name__, reduction)
        if not 0.0 < gamma <= 1.0:
            raise ValueError(
                f"IntraOptionQLoss needs a discount gamma in (0, 1] per base step; got {gamma}."
            )
        self.delay_value = delay_value
        self.convert_to_functional(
            qvalue_network, "qvalue_network", create_target_params=delay_value
        )
        self.__dict__["termination_network"] = termination_network  # read only: its owner's
        self.register_buffer("gamma", torch.tensor(float(gamma)))
        self.loss_function = loss_function
        self.reduction = reduction

    def _set_in_keys(self) -> None:
        keys = self.tensor_keys
        own = {unravel_key(keys.skill)}
        root = [key for key in self.qvalue_network.in_keys if unravel_key(key) not in own]
        read = [*root, *getattr(self.termination_network, "in_keys", ())]
        read = [key for key in read if unravel_key(key) not in own]
        in_next = [("next", key) for key in (*read, keys.reward, keys.terminated, keys.duration)]
        found = [unravel_key(key) for key in (keys.skill, *root, *in_next)]
        self._in_keys = list(dict.fromkeys(found))

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that ``forward`` reads."""
        if self._in_keys is None:
            self._set_in_keys()
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        self._in_keys = None

    @torch.no_grad()
    def target(self, tensordict: TensorDictBase) -> Tensor:
        """Returns what Q(s, o) should be, ``[*B]``."""
        keys = self.tensor_keys
        option = tensordict.get(keys.skill)
        next_td = _next_with_option(tensordict, keys)
        params = self.target_qvalue_network_params if self.delay_value else None
        params = self.qvalue_network_params.detach() if params is None else params
        with params.to_module(self.qvalue_network, preserve_module_state=False):
            values = self.qvalue_network(next_td).get(keys.action_value)
        _check_values("IntraOptionQLoss", values, option)
        value = values.amax(-1)
        if self.termination_network is not None:
            logits = self.termination_network(next_td).get(keys.termination_logits)
            same = values.gather(-1, option.unsqueeze(-1)).squeeze(-1)
            value = torch.lerp(same, value, logits.sigmoid().reshape(value.shape))
        reward, terminated = (next_td.get(k).reshape(value.shape) for k in _pair(keys))
        duration = next_td.get(keys.duration, None)
        discount = self.gamma if duration is None else self.gamma ** duration.reshape(value.shape)
        return reward + discount * value * ~terminated

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        keys = self.tensor_keys
        target = self.target(tensordict)
        read = tensordict.select(*self.qvalue_network.in_keys)
        with self.qvalue_network_params.to_module(self.qvalue_network, preserve_module_state=False):
            values = self.qvalue_network(read).get(keys.action_value)
        chosen = values.gather(-1, tensordict.get(keys.skill).unsqueeze(-1)).squeeze(-1)
        loss = distance_loss(chosen, target, self.loss_function)
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(loss, tensordict=tensordict, weights=weights)
        error = (chosen.detach() - target).abs()
        if self.reduction != "none":
            error = error.mean()
        batch_size = tensordict.batch_size if self.reduction == "none" else []
        out = TensorDict({"loss_qvalue": loss, "td_error": error}, batch_size=batch_size)
        names = ["qvalue_network_params"]
        names += ["target_qvalue_network_params"] if self.delay_value else []
        self._clear_weakrefs(tensordict, out, *names)
        return out


def _next_with_option(tensordict: TensorDictBase, keys: Any) -> TensorDictBase:
    """The entries after the step, with the option that led there; zeros where it terminated."""
    after = tensordict.get("next")
    reward = unravel_key(getattr(keys, "reward", ""))
    read = [key for key in after.keys(True, True) if key != reward]
    after = without_terminal_entries(after, after.get(keys.terminated), read)
    return after.set(keys.skill, tensordict.get(keys.skill))


def _pair(keys: Any) -> tuple[NestedKey, NestedKey]:
    return keys.reward, keys.terminated


def _check_values(owner: str, values: Tensor, option: Tensor) -> None:
    if values.shape[:-1] != option.shape:
        raise ValueError(
            f"{owner} needs action values [*B, A] and options [*B]; got {list(values.shape)} and "
            f"{list(option.shape)}. One-hot options become indices by option.long().argmax(-1)."
        )

"""A trained skill actor, or any policy of TorchRL, as the worker of a pool.

Letters: F features, Z skills, D numbers of an action.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_hmcts.checks import instance, whole_number
from torchrl_hmcts.envs.gym.shared_network import SharedNetwork, choose, run_network
from torchrl_hmcts.modules import ConcatSkillMLP, SkillActor, SkillMLP
from torchrl_hmcts.modules.skill_spec import described
from torchrl_hmcts.processes import share

# NormalParamExtractor's mapping of the raw scale: softplus(x + shift) + least, 1 at x = 0.
_LEAST_SCALE = 0.01
_SHIFT = float(np.log(np.expm1(1.0 - _LEAST_SCALE)))


class SkillWorker:
    r"""Acts as a :class:`SkillActor` inside the processes of a pool.

    Its options are the actor's skills, or some vectors of them. The weights are a copy in shared
    memory: :meth:`load` writes new ones, which the processes use from their next step on. For a
    ``SkillMLP`` or ``ConcatSkillMLP`` of linear layers and ReLU, one forward pass takes a few
    microseconds; another network runs in torch.

    Args:
        actor (SkillActor): of discrete or continuous actions; its ``in_keys`` name entries of the
            env's observation, ``"observation"`` where that is one array.
        deterministic (bool): take the most probable action, or the squashed mean, instead of a
            sample. Default False.
        skills (Tensor, optional): ``[Z, D]``, of an actor whose skills are vectors those that are
            the options, e.g. of :func:`~torchrl_hmcts.modules.spread_skills`.

    Raises:
        TypeError: if ``actor`` is something else.
        ValueError: if ``skills`` does not fit the actor.
        OSError: if there is too little shared memory.

    Reference:
        This project's; the actors are those of :mod:`torchrl_hmcts.modules`.

    Example:
        >>> from torchrl.data import Categorical
        >>> from torchrl_hmcts.envs import OptionPool, SkillWorker
        >>> from torchrl_hmcts.modules import SkillActor
        >>> actor = SkillActor(4, Categorical(2), num_skills=3, in_keys=["observation"])
        >>> pool = OptionPool("CartPole-v1", SkillWorker(actor), max_steps=5, num_processes=0)
        >>> pool.num_options
        3
    """

    def __init__(
        self, actor: SkillActor, *, deterministic: bool = False, skills: Tensor | None = None
    ) -> None:
        instance("SkillWorker", "actor", actor, SkillActor)
        self._told = _as_told(actor, skills)
        self.num_options = len(self._told)
        self._numbered = skills is None
        self.deterministic = bool(deterministic)
        self.keys = [k if isinstance(k, tuple) else (k,) for k in actor.module[0].in_keys[:-1]]
        self._bounds: tuple[np.ndarray, np.ndarray] | None = None
        if not hasattr(actor, "num_actions"):  # continuous
            space = actor.spec[actor.action_key].space
            low, high = space.low.cpu().numpy(), space.high.cpu().numpy()
            self._bounds = (high - low) / 2, (high + low) / 2
        network = actor.network
        self._shown = isinstance(network, ConcatSkillMLP)  # the network is shown the skill
        self._weights: SharedNetwork | None = None
        self._module: nn.Module | None = None
        if type(network) in (SkillMLP, ConcatSkillMLP) and _is_plain(network):
            layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
            widths = [layer.out_features for layer in layers[:-1]]
            heads = 1 if self._shown else self.num_options
            self._weights = SharedNetwork(
                layers[0].in_features, layers[-1].out_features // heads, heads, widths
            )
        else:
            self._module = copy.deepcopy(network).cpu().requires_grad_(False)
            share([*self._module.parameters(), *self._module.buffers()], "SkillWorker")
        self.load(actor)

    def load(self, actor: SkillActor) -> None:
        """Take over the weights of an actor of the same shape, in the processes too.

        Raises:
            ValueError: if its network has other sizes.
        """
        if self._weights is not None:
            self._weights.load(actor.network.parameters())
            return
        assert self._module is not None
        with torch.no_grad():
            own = self._module.state_dict()
            for name, value in actor.network.state_dict().items():
                own[name].copy_(value)

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> Any:
        """Return an action of a skill: an index, or float32 ``[D]``."""
        x = self._features(observation)
        draw = -1.0 if self.deterministic else generator.random() if self._bounds is None else 0.0
        if self._weights is None:
            outputs = self._run_module(x, option)
            if self._bounds is None:
                return _pick(outputs, draw)
        else:
            net, head = self._weights, option
            if self._shown:
                x, head = np.concatenate([x, self._told[option]]), 0
            arrays = x, net._array, net._sizes, net._heads[head], net._logits
            if self._bounds is None:
                return int(choose(*arrays, draw, 1.0))
            run_network(*arrays, 1.0)
            outputs = net._logits
        size = len(outputs) // 2
        loc, raw = outputs[:size], outputs[size:]
        if not self.deterministic:
            scale = np.logaddexp(0.0, raw + _SHIFT) + _LEAST_SCALE
            loc = loc + scale * generator.standard_normal(len(loc))
        half, middle = self._bounds
        return (half * np.tanh(loc) + middle).astype(half.dtype)

    def _features(self, observation: Any) -> np.ndarray:
        if not isinstance(observation, dict):
            return np.asarray(observation, np.float32).reshape(-1)
        parts = []
        for path in self.keys:
            part = observation
            for name in path:
                part = part[name]
            parts.append(np.asarray(part, np.float32).reshape(-1))
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _run_module(self, x: np.ndarray, option: int) -> np.ndarray:
        assert self._module is not None
        told = torch.tensor(option) if self._numbered else torch.from_numpy(self._told[option])
        with torch.no_grad():
            return self._module(torch.from_numpy(x), told).numpy()


def _as_told(actor: SkillActor, skills: Tensor | None) -> np.ndarray:
    """Input for each option of a network that reads the skill, float32 ``[Z, ...]``."""
    if actor.num_skills is not None and skills is None:
        return np.eye(actor.num_skills, dtype=np.float32)
    size = actor.skill_spec.shape[-1:]
    if actor.num_skills is not None or skills is None or skills.shape[1:] != size:
        wanted = "no skills=" if actor.num_skills is not None else f"skills= of [Z, {size[0]}]"
        got = "none" if skills is None else list(skills.shape)
        raise ValueError(
            f"SkillWorker of an actor that knows {described(actor.skill_spec)} needs {wanted}; got "
            f"{got}."
        )
    return np.ascontiguousarray(skills.detach().cpu().numpy(), np.float32)


def _pick(logits: np.ndarray, draw: float) -> int:
    """The most probable action, or that at which the cumulative probability passes ``draw``."""
    if draw < 0.0:
        return int(logits.argmax())
    shares = np.exp(logits - logits.max())
    return int(min(np.searchsorted(np.cumsum(shares), draw * shares.sum()), len(shares) - 1))


def _is_plain(network: nn.Module) -> bool:
    """Whether a network has nothing but linear layers and ReLU."""
    leaves = [layer for layer in network.modules() if not list(layer.children())]
    return all(type(layer) in (nn.Linear, nn.ReLU) for layer in leaves)


class PolicyWorker:
    """Acts as a policy of TorchRL inside the processes of a pool, with its memory in an option.

    The policy reads the env's observation, floats as float32, ``"is_init"``, and the option. What
    it writes under ``"next"``, e.g. a recurrent state, it reads in the next step; an option begins
    without, which TorchRL's recurrent modules take for zeros. It takes its most probable action.
    Weights are a copy in shared memory. A forward pass of torch takes a few hundred microseconds:
    for a network of linear layers :class:`SkillWorker` is many times as fast.

    Args:
        policy (TensorDictModuleBase): writes an action; it is not changed.
        num_options (int): that it knows.
        option_key (NestedKey): entry that tells the option, int64 ``[]``. Default ``"skill"``.
        action_key (NestedKey): entry of its action. Default ``"action"``.

    Raises:
        ValueError: if ``num_options`` is below 1.
        OSError: if there is too little shared memory.

    Reference:
        This project's; recurrent modules are those of ``torchrl.modules``.

    Example:
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from torchrl.modules import GRUModule
        >>> from torchrl_hmcts.envs import OptionPool, PolicyWorker
        >>> policy = TensorDictSequential(
        ...     GRUModule(4, 8, in_keys=["observation", "memory", "is_init"],
        ...               out_keys=["features", ("next", "memory")]),
        ...     TensorDictModule(lambda x, skill: (x.sum(-1) > skill).long(),
        ...                      ["features", "skill"], ["action"]))
        >>> pool = OptionPool(
        ...     "CartPole-v1", PolicyWorker(policy, 2), max_steps=5, num_processes=0, seed=0)
        >>> pool.rollout(2, lambda td: td.set("option", torch.tensor(0)))["observation"].shape
        torch.Size([2, 4])
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        num_options: int,
        *,
        option_key: NestedKey = "skill",
        action_key: NestedKey = "action",
    ) -> None:
        self.num_options = whole_number("PolicyWorker", "num_options", num_options, least=1)
        own: Any = copy.deepcopy(policy).cpu().requires_grad_(False)
        own.eval()
        self._policy = own
        share([*self._policy.parameters(), *self._policy.buffers()], "PolicyWorker")
        self._option_key, self._action_key = option_key, action_key
        self._memory: TensorDictBase | None = None

    def load(self, policy: TensorDictModuleBase) -> None:
        """Take over the weights of a policy of the same shape, in the processes too."""
        self._policy.load_state_dict(policy.state_dict())  # copies, into the shared memory

    def begin(self, observation: Any, option: int) -> None:
        """Forget what came before the option."""
        self._memory = None

    @torch.no_grad()
    def act(self, observation: Any, option: int, generator: np.random.Generator) -> Any:
        """Return an action: a number or an array."""
        seen = observation if isinstance(observation, dict) else {"observation": observation}
        td = TensorDict(_as_tensors(seen))
        td.set("is_init", torch.tensor([self._memory is None]))
        if self._memory is not None:
            td.update(self._memory)
        td.set(self._option_key, torch.tensor(option))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            td = self._policy(td)
        self._memory = td.get("next", TensorDict({}))
        return td.get(self._action_key).numpy()[()]


def _as_tensors(observation: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _as_tensors(part) if isinstance(part, dict) else _as_tensor(part)
        for key, part in observation.items()
    }


def _as_tensor(part: Any) -> Tensor:
    tensor = torch.as_tensor(np.asarray(part))
    return tensor.float() if tensor.is_floating_point() else tensor

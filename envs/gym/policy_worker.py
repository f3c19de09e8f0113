"""Any policy of TorchRL, a recurrent one too, as the worker of a pool."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.processes import share


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
        """Take over the weights of a policy of the same shape, in the processes too.

        Args:
            policy: as that of the constructor.

        Raises:
            RuntimeError: if its weights have other names or shapes.
        """
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

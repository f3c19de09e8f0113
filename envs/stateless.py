"""Simulators whose state is in the tensordict, but which do not say so."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey, expand_as_right
from torchrl.data import Composite
from torchrl.envs import EnvBase


class StatelessSimulator(EnvBase):
    """Declares that a step of an env reads nothing but the tensordict, so that it can be set.

    Brax and other functional simulators are such envs: TorchRL's wrappers hand their whole state
    out, and step from the one they are given, but do not support ``reset(td, set_state=True)``.
    Here that hands the given state back. Wrap the env itself, below transforms;
    :func:`~torchrl_hmcts.testing.check_macro_env` finds out whether what is said is true.

    Args:
        env (EnvBase): whose ``_step`` depends on nothing but its tensordict.
        state_keys (sequence of NestedKey, optional): entries that are the state, and those that
            transforms and workers above read right after a reset to a state. A tree stores them for
            every node. Default: the env's ``state_spec`` and all of its observation.

    Raises:
        ValueError: if the env has no such entry, or no state at all.
        KeyError: when set to a state that lacks an entry.

    Reference:
        Freeman et al., "Brax: a differentiable physics engine for large scale rigid body
        simulation", 2021, arXiv 2106.13281: the kind of simulator that is meant.

    Example:
        >>> from torchrl_hmcts.envs import StatelessSimulator
        >>> from torchrl_hmcts.planners import MCTSPlanner
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> class Shy(ChainEnv):
        ...     batch_locked, _supports_set_state = True, False
        >>> env = StatelessSimulator(Shy(length=4))
        >>> MCTSPlanner(env).plan(env.reset()).options.tolist()
        [1, 1, 1]
    """

    _supports_set_state = True

    def __init__(self, env: EnvBase, state_keys: Sequence[NestedKey] | None = None) -> None:
        super().__init__(device=env.device, batch_size=env.batch_size)
        self.env = env
        known = Composite(shape=env.batch_size, device=env.device)
        for specs in (env.full_observation_spec, env.full_state_spec):
            for key, spec in specs.items(True, True):
                known[key] = spec.clone()
        shown = {unravel_key(key) for key in known.keys(True, True)}
        if not list(env.full_state_spec.keys(True, True)) and state_keys is None:
            raise ValueError(
                f"StatelessSimulator needs to know what the state of {type(env).__name__} is: its "
                f"state_spec is empty. Name the entries that its step reads, e.g. "
                f"state_keys={sorted(map(str, shown))}."
            )
        keys = list(shown) if state_keys is None else [unravel_key(key) for key in state_keys]
        missing = [key for key in keys if key not in shown]
        if missing or not keys:
            raise ValueError(
                f"StatelessSimulator got state_keys={keys}; {type(env).__name__} writes "
                f"{sorted(map(str, shown))}. Name one or more of those."
            )
        state = Composite(shape=env.batch_size, device=env.device)
        for key in sorted(keys, key=str):
            state[key] = known[key].clone()
        self.state_keys_set = keys
        self.observation_spec = env.full_observation_spec.clone()
        self.state_spec = state
        self.action_spec = env.full_action_spec.clone()
        self.reward_spec = env.full_reward_spec.clone()
        self.done_spec = env.full_done_spec.clone()

    @property
    def batch_locked(self) -> bool:
        """True if the env steps only as many states as it holds."""
        return bool(self.env.batch_locked)

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        if not set_state or tensordict is None:
            return self.env._reset(tensordict, **kwargs)
        missing = [key for key in self.state_keys_set if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"StatelessSimulator sets {type(self.env).__name__} to a state, which lacks "
                f"{missing}. Pass a tensordict as reset() or step() gives it."
            )
        return tensordict.select(*self.state_keys_set).clone()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        stepped = tensordict.get("_step", None)
        after = self.env._step(tensordict.exclude("_step"))
        if stepped is not None and not stepped.all():  # the others stay where they are
            for key in after.keys(True, True):
                before = tensordict.get(key, None)
                if before is not None:
                    mask = expand_as_right(stepped.reshape(after.batch_size), before)
                    after.set(key, torch.where(mask, after.get(key), before))
        return after

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            seed = int(torch.empty((), dtype=torch.int64).random_())
        self.env.set_seed(seed)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the env."""
        if not self.env.is_closed:
            self.env.close(raise_if_closed=raise_if_closed)
        super().close(raise_if_closed=False)

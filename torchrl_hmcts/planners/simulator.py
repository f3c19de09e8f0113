"""A macro environment as the planner uses it: states go in, outcomes of options come out.

Letters: ``m`` states of one call, ``A`` options.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import OneHot
from torchrl.envs import EnvBase

from torchrl_hmcts.carried_state import ForeignStates, planning_env
from torchrl_hmcts.checks import nested_key
from torchrl_hmcts.direct_calls import entry, put
from torchrl_hmcts.nesting import complete_done, env_name, step_states
from torchrl_hmcts.planners.simulator_checks import (
    check_durations_and_masks,
    check_env,
    check_rewards_and_ends,
    check_state,
    count_options,
    find_done_keys,
    find_reward_key,
)
from torchrl_hmcts.planners.turns import Turns

_BESIDE = ("step_async", "step_wait", "step_abandon")


class Simulator:
    """Sets a macro environment to states and takes one macro-step from each of them.

    All states of a wave are one call of a stateless env (``batch_locked=False``). If its type has
    ``step_async(td) -> ticket``, ``step_wait(ticket) -> next`` and ``step_abandon(ticket)``, it
    works on several waves beside the planner. An env with a state of its own is set to it, see
    :class:`Turns`.
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        extra_keys: Sequence[NestedKey] = (),
        duration_key: NestedKey | None = "duration",
        mask_key: NestedKey | None = "action_mask",
        reward_key: NestedKey | None = None,
    ) -> None:
        check_env(env)
        name = env_name(env)
        self.stateless = not env.batch_locked
        self.given_env, self.env = env, planning_env(env)
        self._foreign = ForeignStates(env)
        env = self.env
        # Of the type: a TransformedEnv hands on attributes, which would go past its transforms.
        self.works_beside = self.stateless and all(hasattr(type(env), name) for name in _BESIDE)
        self.option_key = env.action_keys[0]
        spec = env.full_action_spec[self.option_key]
        self.num_options = count_options(env, spec)
        self._one_hot, self._option_dtype = isinstance(spec, OneHot), spec.dtype
        # [] for most envs, [1] under an ActionDiscretizer
        self._option_shape = () if self._one_hot else tuple(spec.shape[env.batch_dims :])
        self.state_keys = [unravel_key(k) for k in env.full_state_spec.keys(True, True)]
        available = {unravel_key(k) for k in env.full_observation_spec.keys(True, True)}
        available |= set(self.state_keys)
        self._available, self._name = available, name
        extra = [unravel_key(k) for k in extra_keys]
        self._check_available(extra, "The novelty test or an evaluator")
        self.kept_keys = list(self.state_keys)
        self.duration_key = self._optional("duration_key", duration_key)
        self.mask_key = self._optional("mask_key", mask_key)
        masks = [] if self.mask_key is None else [self.mask_key]
        self.root_keys = list(dict.fromkeys([*self.state_keys, *extra, *masks]))
        self._reward_key = find_reward_key(env, reward_key)
        self._done_spec = env.full_done_spec_unbatched  # a call has m states, not env.batch_size
        self._done_keys = [unravel_key(k) for k in env.done_keys]
        self._done_key, self._terminated_key = find_done_keys(env)
        check_rewards_and_ends(env, self._reward_key, (self._done_key, self._terminated_key))
        check_durations_and_masks(env, self.duration_key, self.mask_key, self.num_options)
        self._turns = Turns(env, self.state_keys, self.option_key, self.encode)
        self._ones = np.ones(0, np.int64)
        self._no_masks = np.zeros((0, self.num_options), np.bool_)

    def root(self, td: TensorDictBase) -> TensorDictBase:
        """Return the root states in one batch dimension, after checking them."""
        if not isinstance(td, TensorDictBase):
            what = type(td).__name__
            how = "planner.plan(env.reset())" if isinstance(td, EnvBase) else "a TensorDict"
            raise TypeError(f"MCTSPlanner plans from a state; got a {what}. Write {how}.")
        check_state(td, self.root_keys)
        flat: TensorDictBase = td.flatten() if len(td.batch_size) != 1 else td
        return flat

    def state(self, td: TensorDictBase) -> TensorDictBase:
        """Return what is stored of a state: all that the simulator continues from, and more."""
        return td.select(*self.kept_keys)

    def keep(self, keys: Sequence[NestedKey]) -> None:
        """Store further entries of the observation with every node, before a search begins."""
        self._check_available(keys, "The policy that executes plans")
        self.kept_keys = list(dict.fromkeys([*self.kept_keys, *keys]))
        self.root_keys = list(dict.fromkeys([*self.root_keys, *keys]))

    def _optional(self, name: str, key: NestedKey | None) -> NestedKey | None:
        """A key of the env, or None if the env has no such entry."""
        found = None if key is None else nested_key("MCTSPlanner", name, key)
        return found if found in self._available else None

    def _check_available(self, keys: Sequence[NestedKey], reader: str) -> None:
        for key in keys:
            if key not in self._available:
                raise ValueError(
                    f"{reader} reads {key!r}, which {self._name} does not have. "
                    f"Its entries: {sorted(map(str, self._available))}."
                )

    def step(self, states: TensorDictBase, options: np.ndarray) -> TensorDictBase:
        """Take option ``options[i]`` in state ``i``; return what the env writes as next."""
        option = self._choose(states, options)
        if self.stateless:
            after = step_states(self.env, states)
        else:
            after = self._turns.step(states, option)
        return self._completed(states, after)

    def send(self, states: TensorDictBase, options: np.ndarray) -> Any:
        """Begin what :meth:`step` does; :meth:`receive` returns its outcome, in any order."""
        if not self.works_beside:
            return self.step(states, options)
        self._choose(states, options)
        return states, self.env.step_async(states)

    def receive(self, sent: Any) -> TensorDictBase:
        """Wait for what :meth:`send` began; return what the env writes as next."""
        if not self.works_beside:
            after: TensorDictBase = sent
            return after
        states, ticket = sent
        return self._completed(states, self.env.step_wait(ticket))

    def abandon(self, sent: Any) -> None:
        """Give up what :meth:`send` began."""
        if self.works_beside:
            self.env.step_abandon(sent[1])

    def _choose(self, states: TensorDictBase, options: np.ndarray) -> Tensor:
        """Write the options ``[m]``, encoded, into the states; return them, on the env's device."""
        option = torch.from_numpy(options)
        if self.env.device is not None and self.env.device.type != "cpu":
            option = option.to(self.env.device)
        put(states, self.option_key, self.encode(option))
        return option

    def _completed(self, states: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        if any(entry(after, key) is None for key in self._done_keys):
            complete_done(self.env, after, self._done_spec)
        for key in self.state_keys:
            if entry(after, key) is None:  # the env leaves it as it was
                after.set(key, states.get(key))
        return after

    def searching(self) -> AbstractContextManager[None]:
        """Restore the transforms of the env after a search."""
        return self._foreign.unchanged(self._name)

    def leave(self, td: TensorDictBase) -> None:
        """Set an env with a state of its own back to ``td``, if that is a state of all of it."""
        if not self.stateless and td.batch_size == self.env.batch_size:
            done = torch.from_numpy(self.done(td.reshape(-1))).reshape(*td.batch_size, 1)
            self._turns.leave(td, ~done)

    def encode(self, options: Tensor) -> Tensor:
        """Return option indices ``[*B]`` in the form of the env's action spec."""
        if self._one_hot:
            return torch.nn.functional.one_hot(options, self.num_options).to(self._option_dtype)
        if not self._option_shape:
            return options
        return options.reshape((*options.shape, *self._option_shape))

    def rewards(self, after: TensorDictBase) -> np.ndarray:
        """Return the rewards, float32 ``[m]``."""
        reward = _required(after, self._reward_key)
        return _array(reward if reward.dtype == torch.float32 else reward.to(torch.float32))

    def done(self, td: TensorDictBase) -> np.ndarray:
        """Return which states have ended, or are no longer stepped by a rollout, bool ``[m]``."""
        done = self._flag(td, self._done_key)
        stepped = entry(td, "_step")
        return done if stepped is None else done | ~_array(stepped)

    def terminated(self, td: TensorDictBase) -> np.ndarray:
        """Return which states are terminal, bool ``[m]``."""
        return self._flag(td, self._terminated_key)

    def durations(self, after: TensorDictBase) -> np.ndarray:
        """Return base steps per macro-step, int64 ``[m]``."""
        if self.duration_key is None:
            if len(self._ones) != after.batch_size[0]:
                self._ones = np.ones(after.batch_size[0], np.int64)
            return self._ones
        durations = _array(_required(after, self.duration_key))
        return durations if durations.dtype == np.int64 else durations.astype(np.int64)

    def masks(self, td: TensorDictBase) -> np.ndarray:
        """Return which options may be taken, bool ``[m, A]``, or ``[0, A]`` for all."""
        if self.mask_key is None:
            return self._no_masks
        masks = _array(_required(td, self.mask_key)).reshape(-1, self.num_options)
        return masks if masks.dtype == np.bool_ else masks.astype(np.bool_)

    def _flag(self, td: TensorDictBase, key: NestedKey) -> np.ndarray:
        flag = entry(td, key)
        return np.zeros(td.batch_size[0], np.bool_) if flag is None else _array(flag)


def _required(td: TensorDictBase, key: NestedKey) -> Tensor:
    found = entry(td, key)
    return td.get(key) if found is None else found  # whose error names the key


def _array(value: Tensor) -> np.ndarray:
    """The numbers of a tensor in one dimension."""
    if value.device.type != "cpu":
        value = value.cpu()
    array: np.ndarray = value.numpy().reshape(-1)
    return array

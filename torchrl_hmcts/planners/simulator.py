"""A macro environment as the planner sees it: states in, outcomes of options out.

Two kinds of env can be set to any state. A stateless one (``batch_locked=False``) keeps its state
in the tensordict: all states of a wave are one call. If its type has ``step_async(td) -> ticket``,
``step_wait(ticket) -> next`` and ``step_abandon(ticket)``, as that of :class:`AtariOptionPool`, it
works on several waves beside the planner; every ticket is waited for, or given up where that fails.
One with a state of its own (e.g. TorchRL's MuJoCo envs) is set by ``reset(td, set_state=True)`` and
steps as many states at a time as its batch size holds.

Letters: ``m`` states of one call, ``A`` options.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Categorical, OneHot, TensorSpec
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_hmcts.carried_state import ForeignStates, planning_env
from torchrl_hmcts.nesting import env_name, flat_transforms, set_states, step_states

_BESIDE = ("step_async", "step_wait", "step_abandon")


class Simulator:
    """Sets a macro environment to states and takes one macro-step from each of them.

    Args:
        env: the macro environment.
        extra_keys: further entries that novelty tests and evaluators read.
        duration_key: base steps of a macro-step. None: 1.
        mask_key: options that may be taken. None: all.
        reward_key: Default: the env's only reward.

    Raises:
        ValueError: if the env cannot be set to a state or has no single discrete action.
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
        if not isinstance(env, EnvBase):
            raise TypeError(
                f"MCTSPlanner plans in a TorchRL env; got {type(env).__name__}. Wrap a Gymnasium "
                f"env as described in TorchRL's GymWrapper, with a state that can be set."
            )
        name = env_name(env)
        self.stateless = not env.batch_locked
        if not (env._supports_set_state or self.stateless):
            raise ValueError(
                f"MCTSPlanner needs an env it can set to any state; {name} cannot "
                f"(_supports_set_state={env._supports_set_state}, "
                f"batch_locked={env.batch_locked}). Make a Gymnasium env by "
                f"SettableGymEnv(its id). Of others use one that is stateless, e.g. "
                f"WaterworldMazeEnv(), or one whose reset(td, set_state=True) restores the state "
                f"in td. If all that its step reads is in the tensordict already, declare it by "
                f"StatelessSimulator(env)."
            )
        if len(env.action_keys) != 1:
            raise ValueError(
                f"MCTSPlanner chooses one option per step; {name} has the actions "
                f"{env.action_keys}."
            )
        if not list(env.full_state_spec.keys(True, True)):
            raise ValueError(
                f"{name} has an empty state_spec, so its state cannot be stored in a tree. Declare "
                f"in state_spec every entry that its _step reads or that reset(td, set_state=True) "
                f"restores (for TorchRL's MujocoEnv qpos and qvel, by a transform)."
            )
        self.given_env, self.env = env, planning_env(env)
        self._foreign = ForeignStates(env)
        env = self.env
        # Of the type: a TransformedEnv hands on attributes, which would go past its transforms.
        self.works_beside = self.stateless and all(hasattr(type(env), name) for name in _BESIDE)
        self.option_key = env.action_keys[0]
        spec = env.full_action_spec[self.option_key]
        self._one_hot = isinstance(spec, OneHot)
        self._option_dtype = spec.dtype
        boxes = getattr(spec.space, "boxes", [spec.space])  # the Multi specs have one per entry
        # [] for most envs, [1] under an ActionDiscretizer
        shape = () if self._one_hot else tuple(spec.shape[env.batch_dims :])
        single = len(boxes) == 1 and _one_number(
            spec.shape[:-1] if self._one_hot else spec.shape, env
        )
        if not isinstance(spec, (Categorical, OneHot)) or not single:
            raise ValueError(
                f"MCTSPlanner searches one discrete action; {name} has {spec}. Put the env under "
                f"an OptionTransform, or discretise its action with torchrl's ActionDiscretizer."
            )
        self.num_options = int(boxes[0].n)
        self._option_shape = shape
        self.state_keys = [unravel_key(k) for k in env.full_state_spec.keys(True, True)]
        available = {unravel_key(k) for k in env.full_observation_spec.keys(True, True)}
        available |= set(self.state_keys)
        self._available, self._name = available, name
        extra = [unravel_key(k) for k in extra_keys]
        self._check_available(extra, "The novelty test or an evaluator")
        self.kept_keys = list(self.state_keys)
        shown = [None if key is None else unravel_key(key) for key in (duration_key, mask_key)]
        self.duration_key, self.mask_key = (k if k in available else None for k in shown)
        self.root_keys = list(dict.fromkeys([*self.state_keys, *extra]))
        if self.mask_key is not None:
            self.root_keys = list(dict.fromkeys([*self.root_keys, self.mask_key]))
        self._reward_key = _reward_key(env, name, reward_key)
        self._done_spec = env.full_done_spec_unbatched  # a call has m states, not env.batch_size
        self._done_keys = [unravel_key(k) for k in env.done_keys]
        self._done_key, self._terminated_key = _done_keys(env, name)
        self._check_specs(env)
        last = flat_transforms(env)[-1:] if type(env) is TransformedEnv else []
        self._run_from = getattr(last[0], "run_from", None) if last else None
        self._ones = np.ones(0, np.int64)
        self._no_masks = np.zeros((0, self.num_options), np.bool_)

    def _check_specs(self, env: EnvBase) -> None:
        """Refuse entries of which a search would read other numbers than are meant."""
        name = self._name
        reward = env.full_reward_spec[self._reward_key]
        if not _one_number(reward.shape, env) or reward.dtype.is_complex:
            raise ValueError(
                f"MCTSPlanner plans for one reward, a real number per step; the reward "
                f"{self._reward_key!r} of {name} is {_described(reward, env)}. Make one number of "
                f"it, e.g. by torchrl's LineariseRewards or a transform of your own."
            )
        for key in (self._done_key, self._terminated_key):
            done = env.full_done_spec[key]
            if not _one_number(done.shape, env) or done.dtype != torch.bool:
                raise ValueError(
                    f"MCTSPlanner needs one end per state, a bool [1]; {key!r} of {name} is "
                    f"{_described(done, env)}. Reduce it, e.g. by any(-1, keepdim=True), in a "
                    f"transform."
                )
        shown = env.full_observation_spec
        if self.duration_key is not None:
            duration = shown[self.duration_key]
            integer = not (duration.dtype.is_floating_point or duration.dtype.is_complex)
            if not _one_number(duration.shape, env) or not integer or duration.dtype == torch.bool:
                raise ValueError(
                    f"MCTSPlanner reads the base steps of a step, an int64 [1], from "
                    f"{self.duration_key!r}; in {name} that is {_described(duration, env)}. Name "
                    f"another entry by duration_key, or None if every step is one."
                )
        if self.mask_key is not None:
            mask = shown[self.mask_key]
            if mask.shape[env.batch_dims :].numel() != self.num_options:
                raise ValueError(
                    f"MCTSPlanner reads which of the {self.num_options} options may be taken, bool "
                    f"[{self.num_options}], from {self.mask_key!r}; in {name} that is "
                    f"{_described(mask, env)}. Name the options' own mask by mask_key, or None if "
                    f"all may be taken."
                )
            below = _masks_actions_below_options(env, self.mask_key)
            if below:
                raise ValueError(
                    f"MCTSPlanner reads which options may be taken from {self.mask_key!r}, which "
                    f"{name} writes of its {below} base actions, below the OptionTransform. Write "
                    f"the options' own mask in a transform behind it, or pass mask_key=None."
                )

    def root(self, td: TensorDictBase) -> TensorDictBase:
        """Return the root states in one batch dimension, after checking them."""
        missing = [key for key in self.root_keys if td.get(key, None) is None]
        if missing:
            raise ValueError(
                f"The state to plan from lacks {missing}. Pass a tensordict as env.reset() or "
                f'env.step(td)["next"] gives it; this one has '
                f"{sorted(map(str, td.keys(True, True)))}."
            )
        for key in self.root_keys:
            value = td.get(key)
            if value.is_floating_point() and not torch.isfinite(value).all():
                bad = value[~torch.isfinite(value)][0].item()
                raise ValueError(
                    f'The state to plan from has "{key}" = {bad}. A state that is not finite '
                    f"cannot be simulated; find the step that wrote it."
                )
        flat: TensorDictBase = td.flatten() if len(td.batch_size) != 1 else td
        return flat

    def state(self, td: TensorDictBase) -> TensorDictBase:
        """Return what is stored of a state: that from which the simulator can go on, and more."""
        return td.select(*self.kept_keys)

    def keep(self, keys: Sequence[NestedKey]) -> None:
        """Store further entries of the observation with every node, before a search begins."""
        self._check_available(keys, "The policy that carries plans out")
        self.kept_keys = list(dict.fromkeys([*self.kept_keys, *keys]))
        self.root_keys = list(dict.fromkeys([*self.root_keys, *keys]))

    def _check_available(self, keys: Sequence[NestedKey], reader: str) -> None:
        for key in keys:
            if key not in self._available:
                raise ValueError(
                    f"{reader} reads {key!r}, which {self._name} does not have. "
                    f"Its entries: {sorted(map(str, self._available))}."
                )

    def step(self, states: TensorDictBase, options: np.ndarray) -> TensorDictBase:
        """Take option ``options[i]`` in state ``i``; return what the env writes as next."""
        self._choose(states, options)
        if self.stateless:
            after = step_states(self.env, states)
        else:
            after = self._step_in_turn(states, options)
        return self._completed(states, after)

    def send(self, states: TensorDictBase, options: np.ndarray) -> Any:
        """Begin what :meth:`step` does; :meth:`receive` returns what comes of it, in any order."""
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
        """Give up what :meth:`send` began and nobody will receive."""
        if self.works_beside:
            self.env.step_abandon(sent[1])

    def _choose(self, states: TensorDictBase, options: np.ndarray) -> None:
        option = torch.from_numpy(options)
        if self.env.device is not None and self.env.device.type != "cpu":
            option = option.to(self.env.device)
        _put(states, self.option_key, self.encode(option))

    def _completed(self, states: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        if any(_entry(after, key) is None for key in self._done_keys):
            self.env._complete_done(self._done_spec, after)
        for key in self.state_keys:
            if _entry(after, key) is None:  # the env leaves it as it was
                after.set(key, states.get(key))
        return after

    def _step_in_turn(self, states: TensorDictBase, options: np.ndarray) -> TensorDictBase:
        """Set an env with a state of its own to as many states as it holds at a time, and step."""
        env, m = self.env, len(states)
        if not env.batch_dims:
            return self._step_one_by_one(states, options)
        size = env.batch_size.numel()
        parts = []
        for begin in range(0, m, size):
            rows = torch.arange(begin, begin + size).clamp_max(m - 1)  # the last one fills up
            part = states[rows].reshape(env.batch_size)
            before = env.reset(part.select(*self.state_keys), set_state=True)
            # A reset sets what transforms keep in the tensordict, e.g. a step count, back to 0.
            after = env.step(before.update(part)).get("next")
            parts.append(after.reshape(-1)[: min(size, m - begin)])
        return torch.cat(parts) if len(parts) > 1 else parts[0]

    def _step_one_by_one(self, states: TensorDictBase, options: np.ndarray) -> TensorDictBase:
        """Set an env of one state to each of the states, and step."""
        parts = []
        alone = states.select(*self.state_keys).unbind(0)
        for state, option in zip(alone, torch.from_numpy(options), strict=True):
            after = None if self._run_from is None else self._run_from(state, option)
            if after is None:
                root = set_states(self.env, state).update(state)
                _put(root, self.option_key, self.encode(option))
                after = step_states(self.env, root)
            parts.append(after)
        stacked: TensorDictBase = torch.stack(parts)
        return stacked

    @contextmanager
    def searching(self) -> Iterator[None]:
        """Let nothing that a search does stay in the transforms of the env.

        Raises:
            ValueError: at the end, if a transform of another project kept something.
        """
        before = self._foreign.read()
        try:
            yield
        finally:
            changed = self._foreign.changed(before)
            if changed is not None:
                self._foreign.put_back(before)
        if changed is not None:
            raise ValueError(
                f"{changed} of {self._name} changed while MCTSPlanner searched: a transform keeps "
                f"a state in itself, which cannot be set, so that nodes of the tree see each "
                f"other's. Keep it in the tensordict: read it from the first argument of _step, "
                f"write it to the second, and declare it in the state and observation specs."
            )

    def leave(self, td: TensorDictBase) -> None:
        """Set an env with a state of its own back to ``td``, if that is a state of all of it."""
        if self.stateless or td.batch_size != self.env.batch_size:
            return
        goes_on = ~torch.from_numpy(self.done(td.reshape(-1))).reshape(*td.batch_size, 1)
        if goes_on.any():  # a state at its end is reset by whoever acts
            state = td.select(*self.state_keys)
            if not goes_on.all():
                for key in self.env.reset_keys:
                    state.set(key, goes_on.to(self.env.device))
            self.env.reset(state, set_state=True)

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
        rewards = _array(reward if reward.dtype == torch.float32 else reward.to(torch.float32))
        if not np.isfinite(rewards).all():
            raise ValueError(
                f"The simulator returned a reward of {rewards[~np.isfinite(rewards)][0]}. Rewards "
                f"must be finite; find the state from which the env wrote it."
            )
        return rewards

    def done(self, td: TensorDictBase) -> np.ndarray:
        """Return which states end the episode, bool ``[m]``; False where a root does not say.

        A rollout marks the elements it no longer steps with ``"_step"`` False and fills them with
        zeros, which are no state to plan from: they have ended too.
        """
        done = self._flag(td, self._done_key)
        stepped = _entry(td, "_step")
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
        flag = _entry(td, key)
        return np.zeros(td.batch_size[0], np.bool_) if flag is None else _array(flag)


def _entry(td: TensorDictBase, key: NestedKey) -> Tensor | None:
    """An entry or None; ``TensorDict.get`` unravels its key at ten times the cost of the look-up.

    ``key`` is unravelled already.
    """
    if isinstance(key, str):
        entry: Tensor | None = td._get_str(key, None)
    else:
        entry = td._get_tuple(key, None)
    return entry


def _required(td: TensorDictBase, key: NestedKey) -> Tensor:
    entry = _entry(td, key)
    return td.get(key) if entry is None else entry  # whose error names the key


def _put(td: TensorDictBase, key: NestedKey, value: Tensor) -> None:
    if isinstance(key, str):
        td._set_str(key, value, validated=True, inplace=False, non_blocking=False)
    else:
        td.set(key, value)


def _array(value: Tensor) -> np.ndarray:
    """The numbers of a tensor in one dimension."""
    if value.device.type != "cpu":
        value = value.cpu()
    array: np.ndarray = value.numpy().reshape(-1)
    return array


def _reward_key(env: EnvBase, name: str, reward_key: NestedKey | None) -> NestedKey:
    keys = [unravel_key(k) for k in env.reward_keys]
    if reward_key is not None and unravel_key(reward_key) in keys:
        return unravel_key(reward_key)
    if reward_key is not None or len(keys) != 1:
        raise ValueError(
            f"MCTSPlanner plans for one reward; {name} has {keys}, and reward_key is "
            f"{reward_key!r}. Name one of them, e.g. reward_key={keys[0]!r}."
        )
    return keys[0]


def _masks_actions_below_options(env: EnvBase, mask_key: NestedKey) -> int:
    """The number of base actions if the mask is theirs and nobody behind the options wrote it."""
    transforms = flat_transforms(env) if isinstance(env, TransformedEnv) else []
    for transform in reversed(transforms):
        if mask_key in map(unravel_key, transform.out_keys):
            return 0
        if hasattr(transform, "num_options"):  # the options are made here
            parent = transform.parent
            if mask_key not in map(unravel_key, parent.full_observation_spec.keys(True, True)):
                return 0
            actions = [getattr(s.space, "n", 0) for s in parent.full_action_spec.values(True, True)]
            numel = parent.full_observation_spec[mask_key].shape[parent.batch_dims :].numel()
            return next((int(n) for n in actions if n == numel), 0)
    return 0


def _done_keys(env: EnvBase, name: str) -> tuple[NestedKey, NestedKey]:
    """The entries that say that a state is the last of its episode, and that it is terminal."""
    keys = [unravel_key(k) for k in env.done_keys]
    ends = [k for k in keys if _last(k) == "done"]
    if "done" not in ends and len(ends) != 1:
        raise ValueError(
            f"MCTSPlanner needs one entry that says that an episode is over; {name} has {ends}. "
            f'Write "done" in a transform, e.g. where all of them are.'
        )
    done = "done" if "done" in ends else ends[0]
    terminated = "terminated" if isinstance(done, str) else (*done[:-1], "terminated")
    return done, terminated if terminated in keys else done


def _one_number(shape: torch.Size, env: EnvBase) -> bool:
    """Whether an entry has one number per element of the env's batch."""
    return shape[: env.batch_dims] == env.batch_size and shape[env.batch_dims :].numel() == 1


def _described(spec: TensorSpec, env: EnvBase) -> str:
    return f"{spec.dtype} {list(spec.shape[env.batch_dims :])}"


def _last(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]

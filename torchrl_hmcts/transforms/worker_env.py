"""The base environment as an option's rollout sees it."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import CatFrames, EnvBase, GymLikeEnv, Transform

from torchrl_hmcts.carried_state import CarriedFrames, apart
from torchrl_hmcts.direct_calls import is_plain
from torchrl_hmcts.nesting import flat_transforms, set_states, step_states
from torchrl_hmcts.transforms.base_masks import BaseMasks

_AS_IT_IS = {"validated": True, "inplace": False, "non_blocking": False}

_SPECS = (
    *("action_spec", "full_action_spec", "action_keys", "action_key", "input_spec"),
    *("reward_spec", "full_reward_spec", "reward_keys", "reward_key", "output_spec"),
    *("observation_spec", "full_observation_spec", "state_spec", "full_state_spec"),
    *("done_spec", "full_done_spec", "done_keys", "batch_size", "device", "_is_batched"),
)

if TYPE_CHECKING:
    from torchrl_hmcts.transforms.option import OptionTransform


class WorkerEnv:
    """The env below an OptionTransform: what it reads and writes, and how to step it fast.

    Args:
        parent: the env with all transforms below the OptionTransform.
        transform: the OptionTransform, whose worker is checked against the env.

    Raises:
        ValueError: if the env has several rewards, or the worker does not fit it.
    """

    def __init__(self, parent: EnvBase, transform: OptionTransform) -> None:
        parent = apart(parent)  # rows come and go: their frames are in the tensordict
        base = parent.base_env
        self.batch_locked = parent.batch_locked
        self.masks = BaseMasks(parent)
        if len(parent.reward_keys) != 1:
            raise ValueError(
                f"OptionTransform sums one reward; {type(base).__name__} has the rewards "
                f"{parent.reward_keys}. Reduce them to one with a transform before it."
            )
        self.reward_key = parent.reward_keys[0]
        self.action_keys = list(parent.action_keys)
        self.done_keys = [k for k in parent.done_keys if _last(k) == "done"]
        self._env = base if not len(parent.transform) else parent
        self._parent = parent
        self._reward_shape = parent.full_reward_spec[self.reward_key].shape
        self._worker = worker = transform.worker
        self._plain = is_plain(worker) and list(worker.out_keys) == self.action_keys
        keys = [*parent.full_observation_spec.keys(True, True), *parent.state_keys]
        self._flat = all(isinstance(k, str) for k in (*keys, *parent.done_keys, self.reward_key))
        self._done_spec = parent.full_done_spec
        self._complete = set(map(unravel_key, parent.done_keys))
        self._writes_all_done: bool | None = None  # known after the first step
        in_keys = getattr(transform.worker, "in_keys", None)
        # A worker that does not say what it reads may read everything.
        self._read = (
            None if in_keys is None else {_first(k) for k in (*keys, *in_keys, transform.skill_key)}
        )
        # What the env writes under "next" in a base step.
        self.written = {_first(k) for k in (*keys, *parent.done_keys, self.reward_key)}
        # One state at a time: there is nobody to wait for, nor to leave alone. What a worker tells
        # its next step, and options inside an option, take the way of all others.
        memory = any(_first(key) == "next" for key in getattr(worker, "out_keys", ()))
        nested = _first(transform.duration_key) in self.written
        self.alone = self.batch_locked and not (parent.batch_size or memory or nested)
        self._frames = _frames_before(transform)
        self._planning: WorkerEnv | None = None
        self._check_worker(parent, transform)
        if transform.trajectory is not None:
            self.trajectory_spec = transform.trajectory.make_spec(parent)

    def step(self, root: TensorDictBase) -> TensorDictBase:
        """Take a base step, without the bookkeeping of ``EnvBase.step`` where it can be spared."""
        if self.batch_locked and not self.alone:
            return self._parent.step(root).get("next")
        after = step_states(self._env, root)
        if self._writes_all_done is None:
            self._writes_all_done = self._complete.issubset(after.keys(True, True))
            self._reshapes = self.alone and after.get(self.reward_key).shape != self._reward_shape
        if not self._writes_all_done:
            self._env._complete_done(self._done_spec, after)
        if self._reshapes:
            after.set(self.reward_key, after.get(self.reward_key).reshape(self._reward_shape))
        return after

    def for_planning(self) -> WorkerEnv:
        """The same, of an env that looks its specs up once: most of the cost of a GymEnv's step.

        It is to be set to a state before it is stepped: what an env keeps in its attributes is in
        another object than that which is acted in.
        """
        if self._planning is None:
            self._planning = self
            if isinstance(self._env, GymLikeEnv):
                self._planning = copy(self)
                self._planning._env = _with_constant_specs(self._env)
        return self._planning

    def set_state(self, state: TensorDictBase) -> TensorDictBase:
        """Set the env to a state, and return all that it shows there."""
        return self.masks.show(set_states(self._env, state).update(state))

    def act(self, root: TensorDictBase) -> None:
        """Let the worker write its action; a plain network is called on its tensors."""
        worker = self._worker
        if self._plain and not (worker._forward_hooks or worker._forward_pre_hooks):
            action = worker.module(*[root.get(key) for key in worker.in_keys])
            if isinstance(action, Tensor) and isinstance(self.action_keys[0], str):
                root._set_str(self.action_keys[0], action, **_AS_IT_IS)
                return
        worker(root)

    def leave(self, after: TensorDictBase) -> TensorDictBase:
        """Hand the frames after an option's last base step to the CatFrames of the env itself."""
        for frames in self._frames:
            for in_key, out_key in zip(frames.in_keys, frames.out_keys, strict=True):
                setattr(frames, f"_cat_buffers_{in_key}", after.get(out_key).clone())
        return after

    def step_mdp(
        self, root: TensorDictBase, after: TensorDictBase, carried: list[NestedKey]
    ) -> TensorDictBase:
        if not self._flat:
            root = root.copy()
            root.set("next", after)
            return self._parent.step_mdp(root)
        # What the env wrote is the next root as it stands: nobody reads the reward in it.
        following = after.copy() if self.batch_locked and not self.alone else after
        for key in carried:
            following._set_str(key, root._get_str(key, None), **_AS_IT_IS)
        return following

    def carried(self, root: TensorDictBase, after: TensorDictBase) -> list[NestedKey]:
        """Entries that are read in every base step and written by none, e.g. the skill."""
        if not self._flat:
            return []
        written = set(after.keys()) | set(self.action_keys) | {"next"}
        return [
            key
            for key in root.keys()
            if key not in written and (self._read is None or key in self._read)
        ]

    def _check_worker(self, parent: EnvBase, transform: OptionTransform) -> None:
        worker = transform.worker
        name = type(worker).__name__
        td = parent.fake_tensordict().exclude("next", *self.action_keys)
        skill = torch.zeros(td.batch_size, dtype=torch.int64, device=parent.device)
        td.set(transform.skill_key, skill)
        for key in getattr(worker, "in_keys", ()):
            if td.get(key, None) is None:
                raise ValueError(
                    f"The worker {name} reads {key!r}, which {type(parent.base_env).__name__} does "
                    f"not have: it has {sorted(map(str, td.keys(True, True)))}. Change the "
                    f"worker's in_keys, or add a transform that writes {key!r} before "
                    f"OptionTransform."
                )
        self._check_termination(parent, transform)
        with torch.no_grad(), torch.random.fork_rng(devices=[]):  # the check draws no numbers
            worker(td)
        for key in self.action_keys:
            action = td.get(key, None)
            spec = parent.full_action_spec[key]
            if action is None:
                raise ValueError(
                    f"The worker {name} wrote no {key!r}, the action of "
                    f"{type(parent.base_env).__name__}. Give it out_keys=[{key!r}]."
                )
            if action.shape != spec.shape or action.dtype != spec.dtype or not spec.is_in(action):
                raise ValueError(
                    f"The worker {name} wrote {key!r} = {action.dtype} {list(action.shape)} with "
                    f"values up to {action.max().item():g}, which does not fit the env's action "
                    f"spec {spec}. Build the worker from env.action_spec."
                )

    def _check_termination(self, parent: EnvBase, transform: OptionTransform) -> None:
        """Refuse a termination that says it reads what no base step writes."""
        written = {*parent.full_observation_spec.keys(True, True), *parent.state_keys}
        written |= {*parent.done_keys, self.reward_key, transform.skill_key, transform.duration_key}
        available = {unravel_key(key) for key in written}
        for key in getattr(transform.termination, "in_keys", ()):
            if unravel_key(key) not in available:
                raise ValueError(
                    f"The termination {type(transform.termination).__name__} reads {key!r}, which "
                    f"a base step of {type(parent.base_env).__name__} does not write: it writes "
                    f"{sorted(map(str, available))}. Put a transform that writes {key!r} before "
                    f"OptionTransform."
                )


def _with_constant_specs(env: EnvBase) -> EnvBase:
    """A shallow copy of an env in which properties of its specs are attributes of its class."""
    kind = type(env)
    folded = {name: getattr(env, name) for name in _SPECS if hasattr(kind, name)}
    view = copy(env)
    view.__class__ = type(kind.__name__, (kind,), folded)
    return view


def _frames_before(transform: Transform) -> list[CatFrames]:
    """The CatFrames, with buffers of their own, of the env that a transform is part of."""
    found: list[CatFrames] = []
    for before in flat_transforms(transform.container):
        if before is transform:
            break
        if isinstance(before, CatFrames) and not isinstance(before, CarriedFrames):
            found.append(before)
    return found


def _first(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[0]


def _last(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]

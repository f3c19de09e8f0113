"""The base environment as an option's rollout sees it."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import CatFrames, EnvBase, GymLikeEnv, Transform

from torchrl_hmcts.carried_state import CarriedFrames
from torchrl_hmcts.direct_calls import is_plain
from torchrl_hmcts.nesting import flat_transforms, innermost, set_states, step_states
from torchrl_hmcts.transforms.base_masks import BaseMasks
from torchrl_hmcts.transforms.env_below import (
    check_after,
    check_holds_elements,
    duration_key,
    env_below,
    group_shape,
    transforms_before,
    with_constant_specs,
)

_AS_IT_IS = {"validated": True, "inplace": False, "non_blocking": False}

if TYPE_CHECKING:
    from torchrl_hmcts.transforms.option import OptionTransform


class WorkerEnv:
    """The env below an OptionTransform: what it reads and writes, and how to step it fast.

    Args:
        transform: the OptionTransform, whose worker is checked against the env.

    Raises:
        ValueError: if the env has several rewards, steps elements whose option has ended, or the
            worker does not fit it.
    """

    def __init__(self, transform: OptionTransform) -> None:
        parent = env_below(transform)
        base = parent.base_env
        self.batch_locked = parent.batch_locked
        self.masks = BaseMasks(parent)
        if len(parent.reward_keys) != 1:
            raise ValueError(
                f"OptionTransform sums one reward; {type(base).__name__} has the rewards "
                f"{parent.reward_keys}. Reduce them to one with a transform before it."
            )
        if transform.max_steps > 1:
            check_holds_elements(parent)
        check_after(transform)
        self.reward_key = parent.reward_keys[0]
        self.action_keys = list(parent.action_keys)
        self.done_keys = [k for k in parent.done_keys if _last(k) == "done"]
        self.duration_key = duration_key(parent, transform)
        self._env = base if not len(parent.transform) else parent
        self._parent = parent
        self.option_shape = group_shape(parent, transform.option_key)
        self._reward_shape = parent.full_reward_spec[self.reward_key].shape
        self._worker = worker = transform.worker
        self._plain = is_plain(worker) and list(worker.out_keys) == self.action_keys
        keys = [*parent.full_observation_spec.keys(True, True), *parent.state_keys]
        self._done_spec = parent.full_done_spec
        self._complete = set(map(unravel_key, parent.done_keys))
        self._writes_all_done: bool | None = None  # known after the first step
        hooks = Transform._post_step_mdp_hooks
        self._has_hooks = parent.base_env._post_step_mdp_hooks is not None or any(
            type(t)._post_step_mdp_hooks is not hooks for t in flat_transforms(parent)
        )
        self._check_termination(parent, transform)
        root, self.memory, self.unannounced = self._try_worker(parent, transform)
        nested = (*keys, *parent.done_keys, self.reward_key, *self.memory)
        self._flat = all(isinstance(k, str) for k in nested)
        in_keys = getattr(transform.worker, "in_keys", None)
        # A worker that does not say what it reads may read everything.
        self._read = (
            None if in_keys is None else {_first(k) for k in (*keys, *in_keys, transform.skill_key)}
        )
        # What the env writes under "next" in a base step.
        self.written = {_first(k) for k in (*keys, *parent.done_keys, self.reward_key)}
        # One state at a time: there is nobody to wait for, nor to leave alone. What a worker tells
        # its next step, and options inside an option, take the way of all others.
        alone = self.batch_locked and not parent.batch_size
        self.alone = alone and not self.memory and self.duration_key is None
        self._planning: WorkerEnv | None = None
        self._frames = [  # with buffers of their own
            t
            for t in transforms_before(transform)
            if isinstance(t, CatFrames) and not isinstance(t, CarriedFrames)
        ]
        if transform.trajectory is not None:
            self.trajectory_spec = transform.trajectory.make_spec(parent, root, self.memory)

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
        if self.memory:
            kept = root.get("next", None)
            if kept is not None:  # a primer has written the memory of before
                after.update(kept.select(*self.memory))
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
                self._planning._env = with_constant_specs(self._env)
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
        if self._has_hooks or not self._flat:
            root = root.copy()
            root.set("next", after)
            following = self._parent.step_mdp(root)
            if self._has_hooks:
                _, following = self._parent._post_step_mdp_hooks(root, following)
            return following
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

    def durations(self, after: TensorDictBase) -> Tensor | int:
        """Return the base steps of a step, int64 ``[*B, 1]``, or 1 where the env counts none."""
        if self.duration_key is None:
            return 1
        duration: Tensor = after.get(self.duration_key)
        return duration.reshape(*after.batch_size, 1).to(torch.int64)

    def most_base_steps(self, max_steps: int) -> int:
        """Return the base steps that an option can take at most."""
        if self.duration_key is None:
            return max_steps
        spec = self._parent.full_observation_spec[self.duration_key]
        most = int(spec.space.high.max()) if isinstance(spec, Bounded) else 2**31
        return min(max_steps * most, torch.iinfo(torch.int64).max)

    def begin_memory(self, root: TensorDictBase) -> None:
        """Write the zeros with which a recurrent worker begins."""
        shape = root.batch_size
        for key, (event, dtype) in self.memory.items():
            root.set(key, torch.zeros((*shape, *event), dtype=dtype, device=root.device))

    def _try_worker(
        self, parent: EnvBase, transform: OptionTransform
    ) -> tuple[TensorDictBase, dict[NestedKey, tuple[torch.Size, torch.dtype]], list[NestedKey]]:
        """Run the worker once.

        Return what it leaves in the root, its memory, and what of it the env does not announce.
        """
        worker = transform.worker
        name = type(worker).__name__
        env_name = type(parent.base_env).__name__
        td = parent.fake_tensordict().exclude("next", *self.action_keys)
        skill = torch.zeros(self.option_shape, dtype=torch.int64, device=parent.device)
        td.set(transform.skill_key, skill)
        known = getattr(worker, "num_skills", None)
        if isinstance(known, int) and known < transform.num_options:
            raise ValueError(
                f"The worker {name} has {known} skills and is to run {transform.num_options} "
                f"options. Make OptionTransform with num_options={known}, or a worker with more."
            )
        own = {unravel_key(k)[1:] for k in getattr(worker, "out_keys", ()) if _first(k) == "next"}
        own = {unravel_key(k) for k in own}
        for key in getattr(worker, "in_keys", ()):
            if td.get(key, None) is None and unravel_key(key) not in own:
                raise ValueError(
                    f"The worker {name} reads {key!r}, which {env_name} does "
                    f"not have: it has {sorted(map(str, td.keys(True, True)))}. Change the "
                    f"worker's in_keys, or add a transform that writes {key!r} before "
                    f"OptionTransform."
                )
        before = {key: id(value) for key, value in td.items(True, True)}
        with torch.no_grad(), torch.random.fork_rng(devices=[]):  # the check draws no numbers
            try:
                worker(td)
            except KeyError as error:
                raise ValueError(
                    f"The worker {name} reads an entry that {env_name} does not have: {error}. If "
                    f"it is the worker's memory, append its make_tensordict_primer() before "
                    f"OptionTransform."
                ) from error
        for key in self.action_keys:
            action = td.get(key, None)
            spec = parent.full_action_spec[key]
            if action is None:
                raise ValueError(
                    f"The worker {name} wrote no {key!r}, the action of "
                    f"{env_name}. Give it out_keys=[{key!r}]."
                )
            if action.shape != spec.shape or action.dtype != spec.dtype or not spec.is_in(action):
                raise ValueError(
                    f"The worker {name} wrote {key!r} = {action.dtype} {list(action.shape)} with "
                    f"values up to {action.max().item():g}, which does not fit the env's action "
                    f"spec {spec}. Build the worker from env.action_spec."
                )
        self.worker_writes = [
            key
            for key, value in td.items(True, True)
            if _first(key) != "next" and before.get(key) != id(value)
        ]
        ndim = len(parent.batch_size)
        kept = td.get("next", None)
        names = () if kept is None else kept.keys(True, True)
        below = set(map(unravel_key, innermost(parent).full_observation_spec.keys(True, True)))
        memory = {
            unravel_key(key): (kept.get(key).shape[ndim:], kept.get(key).dtype)
            for key in names
            if unravel_key(key) not in below
        }
        for key, (event, dtype) in memory.items():
            if td.get(key, None) is None:  # begin_memory writes it
                td.set(key, torch.zeros((*parent.batch_size, *event), dtype=dtype))
        seen = set(map(unravel_key, parent.full_observation_spec.keys(True, True)))
        lost = [key for key in memory if key not in seen]
        if lost and transform.worker_memory == "keep":
            raise ValueError(
                f"The worker {name} is to keep {lost} from one option to the next, which "
                f"{env_name} does not hand on. Append the worker's make_tensordict_primer() before "
                f"OptionTransform, or take worker_memory='reset'."
            )
        return td, memory, lost

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


def _first(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[0]


def _last(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]

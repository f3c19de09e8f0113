"""The base environment as an option's rollout sees it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import (
    AutoResetTransform,
    Compose,
    EnvBase,
    FrameSkipTransform,
    Transform,
    TransformedEnv,
    VecGymEnvTransform,
)
from torchrl.envs.gym_like import GymLikeEnv

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
        parent = _with_live_transforms(transform)
        base = parent.base_env
        self.batch_locked = parent.batch_locked
        if len(parent.reward_keys) != 1:
            raise ValueError(
                f"OptionTransform sums one reward; {type(base).__name__} has the rewards "
                f"{parent.reward_keys}. Reduce them to one with a transform before it."
            )
        if transform.max_steps > 1:
            _check_holds_elements(parent)
        _check_after(transform)
        self.reward_key = parent.reward_keys[0]
        self.action_keys = list(parent.action_keys)
        self.done_keys = [k for k in parent.done_keys if _last(k) == "done"]
        self.duration_key = _duration_key(parent, transform)
        self._env = base if not len(parent.transform) else parent
        self._parent = parent
        self.option_shape = _group_shape(parent, transform.option_key)
        keys = [*parent.full_observation_spec.keys(True, True), *parent.state_keys]
        self._done_spec = parent.full_done_spec
        self._complete = set(map(unravel_key, parent.done_keys))
        self._writes_all_done: bool | None = None  # known after the first step
        hooks = Transform._post_step_mdp_hooks
        self._has_hooks = parent.base_env._post_step_mdp_hooks is not None or any(
            type(t)._post_step_mdp_hooks is not hooks for t in _flat(parent.transform)
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
        if transform.trajectory is not None:
            self.trajectory_spec = transform.trajectory.make_spec(parent, root, self.memory)

    def step(self, root: TensorDictBase) -> TensorDictBase:
        """Take a base step, without the bookkeeping of ``EnvBase.step`` where it can be spared."""
        if self.batch_locked:
            return self._parent.step(root).get("next")
        after = self._env._step(root)
        if self._writes_all_done is None:
            self._writes_all_done = self._complete.issubset(after.keys(True, True))
        if not self._writes_all_done:
            self._env._complete_done(self._done_spec, after)
        if self.memory:
            kept = root.get("next", None)
            if kept is not None:
                after.update(kept.exclude(*after.keys(True, True)))
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
        following = after.copy() if self.batch_locked else after
        for key in carried:
            following.set(key, root.get(key))
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
        ndim = len(parent.batch_size)
        kept = td.get("next", None)
        names = () if kept is None else kept.keys(True, True)
        below = set(map(unravel_key, parent.base_env.full_observation_spec.keys(True, True)))
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


def rows_of(value: Any, mask: Tensor) -> Any:
    """Return some rows of a tensor; a number is the same for all."""
    return value[mask] if isinstance(value, Tensor) else value


def power(gamma: float, steps: int | Tensor) -> float | Tensor:
    """Return gamma ** steps, in double precision."""
    return gamma**steps if isinstance(steps, int) else gamma ** steps.to(torch.float64)


def discounted(reward: Tensor, discount: float | Tensor) -> Tensor:
    """Return rewards ``[*B, ...]`` times a discount, a number or ``[*B, 1]``."""
    if isinstance(discount, Tensor):
        discount = discount.reshape(*discount.shape[:-1], *[1] * (reward.ndim - discount.ndim + 1))
    return (reward * discount).to(reward.dtype)


def _with_live_transforms(transform: Transform) -> TransformedEnv:
    """The env below a transform, stepped by the transforms themselves.

    TorchRL makes it of copies, so that what a transform learns or counts (``VecNormV2``,
    ``CatFrames``) in the steps inside an option would be lost to the one that is saved and frozen.
    """
    parent = transform.parent
    below: list[Transform] = []
    inside, container = transform, transform.__dict__["_container"]()
    while isinstance(container, Compose):
        parts = list(container.transforms)
        below = parts[: [part is inside for part in parts].index(True)] + below
        inside, container = container, container.__dict__["_container"]()
    if below:
        parent.transform.transforms = nn.ModuleList(below)
    return parent


def _flat(transform: Transform) -> list[Transform]:
    """The transforms within a transform, first to last."""
    if not isinstance(transform, Compose):
        return [transform]
    return [part for inner in transform.transforms for part in _flat(inner)]


def _check_holds_elements(env: EnvBase) -> None:
    """Refuse an env of several elements that steps or resets them all at once."""
    parts: list[Transform] = []
    while isinstance(env, TransformedEnv):
        parts += _flat(env.transform)
        env = env.base_env
    resets = any(isinstance(part, (AutoResetTransform, VecGymEnvTransform)) for part in parts)
    if env.batch_size.numel() > 1 and (resets or isinstance(env, GymLikeEnv)):
        n = env.batch_size.numel()
        raise ValueError(
            f"OptionTransform lets the elements of a batch whose option has ended wait for the "
            f"others; {type(env).__name__} steps, and at their end resets, all its {n} at once, so "
            f"that episodes would go on unseen inside an option. Make {n} envs of one each: "
            f"SerialEnv({n}, make_env) or ParallelEnv({n}, make_env)."
        )


def _check_after(transform: Transform) -> None:
    """Refuse a FrameSkipTransform after the options: it repeats them without discount."""
    container = transform.__dict__["_container"]()
    if not isinstance(container, Compose):
        return
    behind = False
    for part in _flat(container):
        if behind and isinstance(part, FrameSkipTransform):
            raise ValueError(
                "FrameSkipTransform after an OptionTransform would add up the rewards of options "
                "without discount and count the base steps of the last one only. Put it before the "
                "OptionTransform, or repeat options by a second OptionTransform, whose worker "
                f"writes the option again: max_steps={part.frame_skip}."
            )
        behind = behind or part is transform


def _duration_key(env: EnvBase, transform: OptionTransform) -> NestedKey | None:
    """The entry in which the env below counts base steps, if it does."""
    spec = env.full_observation_spec
    available = set(map(unravel_key, spec.keys(True, True)))
    told = transform.base_duration_key
    if told is not None and told not in available:
        raise ValueError(
            f"OptionTransform is to read base steps from {told!r}, which "
            f"{type(env.base_env).__name__} does not write; it writes "
            f"{sorted(map(str, available))}."
        )
    names: list[NestedKey] = [] if told is None else [told]
    below: EnvBase = env
    while not names and isinstance(below, TransformedEnv):
        names = [
            part.duration_key
            for part in reversed(_flat(below.transform))
            if hasattr(part, "duration_key") and hasattr(part, "num_options")
        ][:1]
        below = below.base_env
    names += [transform.duration_key, "duration"]
    for name in names:
        if name in available and _counts(spec[name]):
            return name
    return None


def _counts(spec: TensorSpec) -> bool:
    return spec.dtype in (torch.int32, torch.int64) and spec.shape[-1:] == (1,)


def _group_shape(env: EnvBase, option_key: NestedKey) -> torch.Size:
    """The shape of the options: that of the group of agents in which they are, or the batch's."""
    specs: Composite = env.full_action_spec
    group = () if isinstance(option_key, str) else option_key[:-1]
    if group and unravel_key(group) in specs.keys(True):
        return specs[unravel_key(group)].shape
    return env.batch_size


def _first(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[0]


def _last(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]

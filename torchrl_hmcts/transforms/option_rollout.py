"""A worker's rollout in the env below its options, many elements at a time or one.

Letters: *B batch of the tensordict, n its elements, T ``max_steps``.
"""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import CatFrames, GymLikeEnv, Transform

from torchrl_hmcts.carried_state import CarriedFrames
from torchrl_hmcts.direct_calls import has_hooks, is_plain, put
from torchrl_hmcts.nesting import complete_done, flat_transforms, parts, set_states, step_states
from torchrl_hmcts.transforms.option_checks import (
    check_env,
    duration_key,
    env_below,
    group_shape,
    transforms_before,
    try_worker,
    with_constant_specs,
)
from torchrl_hmcts.transforms.trajectory import BaseMasks, OptionTrajectory


class OptionRollout:
    """Takes the base steps of options in the env below an OptionTransform, if both fit."""

    def __init__(self, transform: Any) -> None:
        self._options, self._parent = transform, env_below(transform)
        parent = self._parent
        self.batch_locked = parent.batch_locked
        self.masks = BaseMasks(parent)
        check_env(transform, parent)
        self.reward_key = parent.reward_keys[0]
        self.option_shape = group_shape(parent, transform.option_key)
        self._reward_shape = parent.full_reward_spec[self.reward_key].shape
        self._action_keys = list(parent.action_keys)
        self._done_keys = [key for key in parent.done_keys if parts(key)[-1] == "done"]
        self._duration_key = duration_key(transform, parent)
        self._env = parent if len(parent.transform) else parent.base_env
        self._done_spec = parent.full_done_spec_unbatched
        self._complete = set(map(unravel_key, parent.done_keys))
        self._writes_all_done: bool | None = None  # known after the first step
        worker = transform.worker
        self._plain = is_plain(worker) and list(worker.out_keys) == self._action_keys
        hook = Transform._post_step_mdp_hooks
        self._has_hooks = parent.base_env._post_step_mdp_hooks is not None or any(
            type(t)._post_step_mdp_hooks is not hook for t in flat_transforms(parent)
        )
        root, self.worker_writes, self.memory, self._unannounced = try_worker(transform, parent)
        shown = [*parent.full_observation_spec.keys(True, True), *parent.state_keys]
        keys = (*shown, *parent.done_keys, self.reward_key)
        self._flat = all(isinstance(key, str) for key in (*keys, *self.memory))
        # A worker that does not say what it reads may read everything.
        in_keys = getattr(worker, "in_keys", None)
        reads = () if in_keys is None else (*shown, *in_keys, transform.skill_key)
        self._read = None if in_keys is None else {parts(key)[0] for key in reads}
        self.written = {parts(key)[0] for key in keys}
        """What the env writes under ``"next"`` in a base step."""
        # One state at a time: there is nobody to wait for, nor to leave alone. What a worker tells
        # its next step, and options inside an option, take the way of all others.
        single = self.batch_locked and not parent.batch_size
        self._alone = single and not self.memory and self._duration_key is None
        self._planning: OptionRollout | None = None
        self._frames = [  # with buffers of their own
            t
            for t in transforms_before(transform)
            if isinstance(t, CatFrames) and not isinstance(t, CarriedFrames)
        ]
        if transform.trajectory is not None:
            self.trajectory_spec = transform.trajectory.make_spec(parent, root, self.memory)

    @property
    def most_base_steps(self) -> int:
        """The base steps that an option can take at most."""
        if self._duration_key is None:
            return self._options.max_steps
        spec = self._parent.full_observation_spec[self._duration_key]
        most = int(spec.space.high.max()) if isinstance(spec, Bounded) else 2**31
        return min(self._options.max_steps * most, torch.iinfo(torch.int64).max)

    def begin_memory(self, root: TensorDictBase) -> None:
        """Write that with which a recurrent worker begins."""
        for key, first in self.memory.items():
            first = first if root.device is None else first.to(root.device)
            root.set(key, first.expand((*root.batch_size, *first.shape)).clone())

    def act(self, root: TensorDictBase) -> None:
        """Let the worker write its action; a plain network is called on its tensors."""
        worker = self._options.worker
        if self._plain and not has_hooks(worker):
            action = worker.module(*[root.get(key) for key in worker.in_keys])
            if isinstance(action, Tensor) and isinstance(self._action_keys[0], str):
                put(root, self._action_keys[0], action)
                return
        worker(root)

    # ---------------------------------------------------------------- rollouts

    @torch.no_grad()
    def run(
        self, root: TensorDictBase, after: TensorDictBase, skipped: Tensor | None
    ) -> TensorDictBase:
        """Continue after the first base step until all options that are not ``skipped`` end."""
        if self._alone and self._options.trajectory is None:
            out = self._run_alone(root, after)
        elif self.batch_locked or not after.batch_size:
            out = self._run_locked(root, after, skipped)
        elif len(after.batch_size) == 1:
            out = self._run_rows(root, after)
        else:
            flat = self._run_rows(root.reshape(-1), after.reshape(-1))
            out = flat.reshape(after.batch_size)
        for frames in self._frames:  # those after the last base step
            for in_key, out_key in zip(frames.in_keys, frames.out_keys, strict=True):
                setattr(frames, f"_cat_buffers_{in_key}", out.get(out_key).clone())
        return out

    @torch.no_grad()
    def run_from(self, state: TensorDictBase, option: Tensor) -> TensorDictBase | None:
        """Set the env to a state and run an option; None where the env holds several states."""
        if not self._alone or self._options.trajectory is not None:
            return None
        if self._planning is None:
            # The same, of an env that looks its specs up once: most of the cost of a GymEnv's step.
            # What an env keeps in its attributes is in another object than that which is acted in.
            self._planning = self
            if isinstance(self._env, GymLikeEnv):
                self._planning = copy(self)
                self._planning._env = with_constant_specs(self._env)
        planning = self._planning
        root = planning.masks.show(set_states(planning._env, state).update(state))
        root.set(self._options.skill_key, self._options.told(option))
        planning.act(root)
        return planning._run_alone(root, planning._step(root))

    def _run_rows(self, root: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        """Continue in a stateless env, with fewer rows whenever some have ended."""
        n = after.batch_size[0]
        reward = after.get(self.reward_key).clone()  # [n, ...], of all rows
        duration = torch.empty((n, 1), dtype=torch.int64, device=reward.device)
        trajectory = self._begin_trajectory(root, after)
        carried = self._find_carried(root, after)
        out: TensorDictBase | None = None
        rows: Tensor | None = None  # the rows that still run; None: all of them
        passed = last = self._durations(after)  # base steps: an int, or [m, 1] of the running rows
        discount: float | Tensor = 1.0
        for taken in range(1, self._options.max_steps):
            ended = self._ended(root, after, passed)
            if ended.any():
                if out is None or rows is None:
                    out = after.clone()
                    rows = torch.arange(n, device=reward.device)
                else:
                    out[rows[ended]] = after[ended]
                duration[rows[ended]] = _rows_of(passed, ended)
                running = ~ended
                rows = rows[running]
                if not rows.numel():
                    break
                root, after = root[running], after[running]
                passed, last, discount = (_rows_of(x, running) for x in (passed, last, discount))
            discount = discount * self._power(last)
            root = self._advance(root, after, carried)
            after = self._step(root)
            gained = _discounted(after.get(self.reward_key), discount)
            if rows is None:
                reward += gained
            else:
                reward.index_add_(0, rows, gained)
            if trajectory is not None:
                trajectory.write(taken, rows, root, after)
            last = self._durations(after)
            passed = passed + last
        if out is None or rows is None:
            out = after
            duration[:] = passed
        elif rows.numel():
            out[rows] = after
            duration[rows] = passed
        return self._finish(out, reward, duration, trajectory)

    def _run_alone(self, root: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        """Continue in an env of one state, whose rows need no masks."""
        first = after.get(self.reward_key)
        # Sums of one number: numpy takes a twentieth of torch's time, and rounds as it does.
        number = np.float64 if first.dtype == torch.float64 else np.float32
        reward = number(first.item())
        carried = self._find_carried(root, after)
        gamma, max_steps = self._options.gamma, self._options.max_steps
        done_key = self._done_keys[0] if len(self._done_keys) == 1 else None
        done_key = done_key if self._options.termination is None else None
        discount, taken = 1.0, 1
        while taken < max_steps:
            if done_key is None:
                ended = self._ended(root, after, taken)
            else:
                ended = after.get(done_key)
            if ended:
                break
            discount *= gamma
            root = self._advance(root, after, carried)
            after = self._step(root)
            reward += number(discount) * number(after.get(self.reward_key).item())
            taken += 1
        dtype = first.dtype if first.is_floating_point() else torch.float32
        total = torch.full_like(first, float(reward), dtype=dtype)
        duration = torch.full((1,), taken, dtype=torch.int64, device=first.device)
        return self._finish(after, total, duration, None)

    def _run_locked(
        self, root: TensorDictBase, after: TensorDictBase, skipped: Tensor | None
    ) -> TensorDictBase:
        """Continue in an env of fixed batch size; ``_step`` tells it whom to leave alone."""
        batch_size = after.batch_size
        out = after.clone()
        reward = out.get(self.reward_key).clone()
        running = torch.ones(batch_size, dtype=torch.bool, device=reward.device)
        if skipped is not None:
            running &= ~skipped
        trajectory = self._begin_trajectory(root, after, running)
        carried = self._find_carried(root, after)
        last = self._durations(after)
        duration = running.unsqueeze(-1) * last  # [*B, 1]
        discount: float | Tensor = 1.0
        for taken in range(1, self._options.max_steps):
            passed = taken if isinstance(last, int) else duration
            running = running & ~self._ended(root, out, passed)
            if not running.any():
                break
            discount = discount * self._power(last)
            root = self._advance(root, out, carried)
            if batch_size and not running.all():
                root.set("_step", running)
            after = self._step(root)
            root = root.exclude("_step")
            gained = _discounted(after.get(self.reward_key), discount)
            reward = torch.where(expand_as_right(running, reward), reward + gained, reward)
            last = self._durations(after)
            duration = duration + running.unsqueeze(-1) * last
            if running.all():
                out = after.clone()
            else:
                out = torch.where(running, after.select(*out.keys(True, True)), out)
            if trajectory is not None:
                trajectory.write(taken, running, root, after)
        return self._finish(out, reward, duration, trajectory)

    # ---------------------------------------------------------------- base steps

    def _step(self, root: TensorDictBase) -> TensorDictBase:
        """Take a base step, without the bookkeeping of ``EnvBase.step`` where it can be spared."""
        if self.batch_locked and not self._alone:
            return self._parent.step(root).get("next")
        after = step_states(self._env, root)
        if self._writes_all_done is None:
            self._writes_all_done = self._complete.issubset(after.keys(True, True))
            self._reshapes = self._alone and after.get(self.reward_key).shape != self._reward_shape
        if not self._writes_all_done:
            complete_done(self._env, after, self._done_spec)
        if self._reshapes:
            after.set(self.reward_key, after.get(self.reward_key).reshape(self._reward_shape))
        if self.memory:
            kept = root.get("next", None)
            if kept is not None:  # a primer has written the memory of before
                after.update(kept.select(*self.memory))
        return after

    def _advance(
        self, root: TensorDictBase, after: TensorDictBase, carried: list[str]
    ) -> TensorDictBase:
        """Return the next root: what the env wrote, and what the worker does there."""
        if self._has_hooks or not self._flat:
            root = root.copy()
            root.set("next", after)
            following = self._parent.step_mdp(root)
            if self._has_hooks:
                _, following = self._parent._post_step_mdp_hooks(root, following)
        else:  # What the env wrote is the next root as it stands: nobody reads the reward in it.
            following = after.copy() if self.batch_locked and not self._alone else after
            for key in carried:
                put(following, key, root.get(key))
        self.act(following)
        return following

    def _find_carried(self, root: TensorDictBase, after: TensorDictBase) -> list[str]:
        """Return entries that are read in every base step and written by none, e.g. the skill."""
        written = {*after.keys(), *self._action_keys, "next"}
        read = self._read
        return [k for k in root.keys() if k not in written and (read is None or k in read)]

    def _ended(self, root: TensorDictBase, after: TensorDictBase, passed: int | Tensor) -> Tensor:
        """Return which options end after a base step, bool ``[*B]``."""
        shape, termination = after.batch_size, self._options.termination
        ended = after.get(self._done_keys[0]).reshape(*shape, -1).any(-1)
        for key in self._done_keys[1:]:
            ended = ended | after.get(key).reshape(*shape, -1).any(-1)
        if termination is None:
            return ended
        seen = after.copy()
        seen.set(self._options.skill_key, root.get(self._options.skill_key))
        if isinstance(passed, int):
            passed = torch.full((*shape, 1), passed, device=ended.device)
        seen.set(self._options.duration_key, passed)
        ends: Any = termination(seen)
        good = isinstance(ends, Tensor) and ends.dtype == torch.bool
        if not good or ends.shape not in (shape, (*shape, 1)):
            got = f"{ends.dtype} {list(ends.shape)}" if isinstance(ends, Tensor) else repr(ends)
            raise ValueError(
                f"The termination {getattr(termination, '__name__', termination)!s} must return "
                f"bool {list(shape)} or {[*shape, 1]}, True where the option ends; it returned "
                f"{got}."
            )
        return ended | ends.reshape(shape)

    def _durations(self, after: TensorDictBase) -> Tensor | int:
        """Return the base steps of a step, int64 ``[*B, 1]``, or 1 where the env counts none."""
        if self._duration_key is None:
            return 1
        duration: Tensor = after.get(self._duration_key)
        return duration.reshape(*after.batch_size, 1).to(torch.int64)

    def _power(self, steps: int | Tensor) -> float | Tensor:
        """Return gamma ** steps, in double precision."""
        exponent = steps if isinstance(steps, int) else steps.to(torch.float64)
        power: float | Tensor = self._options.gamma**exponent
        return power

    def _begin_trajectory(
        self, root: TensorDictBase, after: TensorDictBase, running: Tensor | None = None
    ) -> OptionTrajectory | None:
        if self._options.trajectory is None:
            return None
        trajectory = self._options.trajectory.start(self.trajectory_spec, after.batch_size)
        trajectory.write(0, running, root, after)
        return trajectory

    def _finish(
        self,
        out: TensorDictBase,
        reward: Tensor,
        duration: Tensor,
        trajectory: OptionTrajectory | None,
    ) -> TensorDictBase:
        if self._unannounced:
            out = out.exclude(*self._unannounced)
        self.masks.hide(out)
        out.set(self.reward_key, reward)
        out.set(self._options.duration_key, duration)
        if trajectory is not None:
            out.set(OptionTrajectory.KEY, trajectory.data)
        return out


def _rows_of(value: Any, mask: Tensor) -> Any:
    """Return some rows of a tensor; a number is the same for all."""
    return value[mask] if isinstance(value, Tensor) else value


def _discounted(reward: Tensor, discount: float | Tensor) -> Tensor:
    """Return rewards ``[*B, ...]`` times a discount, a number or ``[*B, 1]``."""
    if isinstance(discount, Tensor):
        discount = discount.reshape(*discount.shape[:-1], *[1] * (reward.ndim - discount.ndim + 1))
    return (reward * discount).to(reward.dtype)

"""Options: a worker's rollout as one step of a macro environment.

Letters: *B batch of the tensordict, n its elements that still run, T ``max_steps``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from numbers import Integral
from typing import Literal

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_as_right
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, OneHot, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform

from torchrl_hmcts.transforms.env_below import discounted, power, rows_of
from torchrl_hmcts.transforms.trajectory import OptionTrajectory
from torchrl_hmcts.transforms.worker_env import WorkerEnv

Termination = Callable[[TensorDictBase], Tensor]
_ROOT = "_option_root_"


class OptionTransform(Transform):
    r"""Wraps each rollout of a worker as one macro-step, so that a planner or a loss sees an SMDP.

    The action of the transformed env is an **option**. One step runs the worker closed-loop in the
    base env, until the option's termination, ``max_steps`` base steps or ``done``. With
    :math:`r_{i+1}` the base rewards and :math:`k` the base steps taken, it writes

    .. math:: \text{reward} = \sum_{i<k} \gamma^i\, r_{i+1}, \qquad \text{duration} = k,

    the done flags, and observation and state after the last base step. Every batch element has its
    own option and its own end; an element that has ended does not step any more.

    The base env's ``"action_mask"`` forbids base actions and no options: worker and termination
    read it by its name, above it is ``"base_action_mask"``. A transform behind this one may write
    the options' own ``"action_mask"``, e.g. :class:`SkillMaskTransform`.

    TorchRL's estimators discount by ``gamma ** steps_to_next_obs``. With
    ``loss.value_estimator.set_keys(steps_to_next_obs=("next", "duration"))``, after every
    ``make_value_estimator``, any TorchRL loss is correct for the SMDP.

    Where the env below counts base steps itself, as one with an OptionTransform does, k is their
    sum and the rewards are discounted by it: options of options have any number of levels.

    Append it last of the transforms that must see base steps, each of which they see once; what is
    appended after it sees macro-steps. The worker is not registered as a sub-module: its owner
    moves, trains and saves it. What a recurrent worker writes under ``"next"`` is its memory; it is
    carried from base step to base step.

    With a group of agents and ``option_key=("agents", "option")`` each agent has an option. Their
    options begin and end together: at the termination, after ``max_steps`` or as soon as any
    ``done`` below is true, an agent's own included. Each agent's rewards are discounted and summed
    by themselves.

    Args:
        worker (TensorDictModuleBase): reads observation or state entries and ``skill_key``, writes
            the env's action.
        num_options (int): number of options.
        max_steps (int): steps of the env below after which an option ends at the latest; of an env
            with options these are options.
        gamma (float): discount per base step, in ``(0, 1]``.
        termination (callable, optional): ``termination(td) -> bool`` tensor ``[*B]`` or
            ``[*B, 1]``, True where the option ends. ``td`` holds the entries after a base step,
            ``skill_key`` and the base steps taken so far under ``duration_key``. Default: none.
        option_key (NestedKey): the macro action, int64 ``[*B]`` (one-hot bool ``[*B, num_options]``
            with ``one_hot=True``); ``[*B, n]`` in a group of n agents. With ``"action"`` every
            TorchRL actor, loss and trainer fits without ``set_keys``. Default ``"option"``.
        skill_key (NestedKey): the entry by which the worker is told the option, int64 ``[*B]``.
            Default ``"skill"``.
        duration_key (NestedKey): base steps taken, int64 ``[*B, 1]``. Default ``"duration"``.
        one_hot (bool): options are one-hot instead of categorical. Default ``False``.
        trajectory_keys (sequence of NestedKey, optional): base transitions to hand out, e.g. to
            train the worker: entries of the env or of the worker, as ``"position"``, ``"skill"``,
            ``"action_log_prob"`` or ``("next", "reward")``, are handed out as
            ``("next", "trajectory", ...)`` of shape ``[*B, T]``, zero after the option's end, with
            ``("next", "trajectory", "mask")``. Default: none.
        base_duration_key (NestedKey, optional): the entry, int64 ``[*B, 1]``, in which the env
            below counts the base steps of each of its steps. Default: that of its
            ``OptionTransform``, else ``duration_key`` or ``"duration"``, if the env has it; without
            one each step is a base step.
        worker_memory (str): ``"reset"`` (default), so that a recurrent worker begins each option
            with zeros and the state of the macro env is that of the env alone, or ``"keep"``, so
            that it begins where the option before ended; the env must then hand its memory on, by
            a ``TensorDictPrimer`` before this transform.

    Raises:
        ValueError: if a number is out of range; when attached to an env: if the worker reads an
            entry the env does not have or writes an action that does not fit the env's action spec,
            or if the env steps or resets elements whose option has ended; when stepping: if an
            option index is out of range, or the termination returns anything but one bool each.

    Reference:
        Sutton, Precup and Singh, "Between MDPs and semi-MDPs", 1999; dissertation, sections 2.2
        and 3.1 (options as the edges of the manager's tree).

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_hmcts.testing import ChainEnv
        >>> from torchrl_hmcts.transforms import OptionTransform
        >>> worker = TensorDictModule(lambda skill: skill, ["skill"], ["action"])
        >>> env = TransformedEnv(ChainEnv(length=6), OptionTransform(worker, 2, 4, gamma=0.5))
        >>> td = env.step(env.reset().set("option", torch.tensor(1)))  # 1: to the right
        >>> td["next", "state"].item(), td["next", "duration"].item()
        (4, 4)
    """

    invertible = True

    def __init__(
        self,
        worker: TensorDictModuleBase,
        num_options: int,
        max_steps: int,
        gamma: float = 0.99,
        termination: Termination | None = None,
        option_key: NestedKey = "option",
        *,
        skill_key: NestedKey = "skill",
        duration_key: NestedKey = "duration",
        one_hot: bool = False,
        trajectory_keys: Sequence[NestedKey] | None = None,
        base_duration_key: NestedKey | None = None,
        worker_memory: Literal["reset", "keep"] = "reset",
    ) -> None:
        if not callable(worker):
            raise ValueError(
                f"OptionTransform needs a worker that it can call on a tensordict; got {worker!r}."
            )
        for name, value in (("num_options", num_options), ("max_steps", max_steps)):
            if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
                raise ValueError(f"OptionTransform needs {name} to be an int >= 1; got {value!r}.")
        if not 0.0 < gamma <= 1.0:
            raise ValueError(
                f"OptionTransform needs a discount gamma in (0, 1] per base step; got {gamma}."
            )
        if worker_memory not in ("reset", "keep"):
            raise ValueError(
                f"OptionTransform needs worker_memory to be 'reset', so that a recurrent worker "
                f"begins each option with zeros, or 'keep'; got {worker_memory!r}."
            )
        self.option_key = unravel_key(option_key)
        self.skill_key = unravel_key(skill_key)
        self.duration_key = unravel_key(duration_key)
        super().__init__(in_keys=[], out_keys=[self.duration_key])
        # Not sub-modules: an env must not put its owner's worker into eval mode or onto its device.
        self.__dict__["worker"] = worker
        self.__dict__["termination"] = termination
        self.num_options = int(num_options)
        self.max_steps = int(max_steps)
        self.gamma = float(gamma)
        self.one_hot = one_hot
        self.worker_memory = worker_memory
        self.base_duration_key = (
            None if base_duration_key is None else unravel_key(base_duration_key)
        )
        self.trajectory = (
            None if trajectory_keys is None else OptionTrajectory(trajectory_keys, max_steps)
        )
        self._fit: WorkerEnv | None = None

    # ---------------------------------------------------------------- stepping

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose the first base action; the env then takes that step as it always does."""
        fit = self._fitted()
        option = tensordict.get(self.option_key, None)
        if option is None:
            raise KeyError(
                f"OptionTransform found no option under {self.option_key!r}. Write it with a "
                f"planner or policy, or with env.rand_action(td)."
            )
        private = [key for key in tensordict.keys() if str(key).startswith(_ROOT)]
        inner = fit.masks.show(tensordict).exclude("_step", "next", *private)
        inner.set(self.skill_key, self._skill(option, fit.option_shape, tensordict.batch_size))
        if self.worker_memory == "reset":
            fit.begin_memory(inner)
        with torch.no_grad():
            fit.act(inner)
        for key in (self.skill_key, *fit.worker_writes):
            tensordict.set(key, inner.get(key))
        # For _step: all that the worker wrote, as it wrote it.
        return tensordict.set(self._root_key, inner)

    @property
    def _root_key(self) -> str:
        return f"{_ROOT}{id(self)}"  # its own: another OptionTransform may stand below

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        fit = self._fitted()
        batch_size = next_tensordict.batch_size
        skipped = tensordict.get("_step", None)
        if skipped is not None:
            skipped = ~skipped.reshape(batch_size)
        root = tensordict.get(self._root_key).exclude(self.option_key)
        if "next" in tensordict.keys():  # of an earlier step from this root: TorchRL copies it over
            next_tensordict = next_tensordict.select(*fit.written)
        kept = root.get("next", None)
        if kept is not None:  # what a recurrent worker goes on with
            next_tensordict.update(kept.select(*fit.memory))
        # One batch dimension is all the loop has to know; without any there are no rows to drop.
        flatten = not fit.batch_locked and len(batch_size) > 1
        if flatten:
            root, next_tensordict = root.reshape(-1), next_tensordict.reshape(-1)
        with torch.no_grad():
            if fit.alone and self.trajectory is None:
                out = self._run_alone(fit, root, next_tensordict)
            elif fit.batch_locked or not batch_size:
                out = self._run_locked(fit, root, next_tensordict, skipped)
            else:
                out = self._run(fit, root, next_tensordict)
        return fit.leave(out.reshape(batch_size) if flatten else out)

    def _run(self, fit: WorkerEnv, root: TensorDictBase, after: TensorDictBase) -> TensorDictBase:
        """Continue in a stateless env, with fewer rows whenever some have ended."""
        n = after.batch_size[0]
        reward = after.get(fit.reward_key).clone()  # [n, ...], of all rows
        duration = torch.empty((n, 1), dtype=torch.int64, device=reward.device)
        trajectory = self._begin_trajectory(fit, root, after)
        carried = fit.carried(root, after)
        out: TensorDictBase | None = None
        rows: Tensor | None = None  # the rows that still run; None: all of them
        passed = last = fit.durations(after)  # base steps: an int, or [m, 1] of the running rows
        discount: float | Tensor = 1.0
        for taken in range(1, self.max_steps):
            ended = self._ended(fit, root, after, passed)
            if ended.any():
                if out is None or rows is None:
                    out = after.clone()
                    rows = torch.arange(n, device=reward.device)
                else:
                    out[rows[ended]] = after[ended]
                duration[rows[ended]] = rows_of(passed, ended)
                running = ~ended
                rows = rows[running]
                if not rows.numel():
                    break
                root, after = root[running], after[running]
                passed, last, discount = (rows_of(x, running) for x in (passed, last, discount))
            discount = discount * power(self.gamma, last)
            root = self._advance(fit, root, after, carried)
            after = fit.step(root)
            gained = discounted(after.get(fit.reward_key), discount)
            if rows is None:
                reward += gained
            else:
                reward.index_add_(0, rows, gained)
            if trajectory is not None:
                trajectory.write(taken, rows, root, after)
            last = fit.durations(after)
            passed = passed + last
        if out is None or rows is None:
            out = after
            duration[:] = passed
        elif rows.numel():
            out[rows] = after
            duration[rows] = passed
        return self._finish(fit, out, reward, duration, trajectory)

    def run_from(self, state: TensorDictBase, option: Tensor) -> TensorDictBase | None:
        """Run an option from a state of an env that holds one; what ``step`` writes as next.

        A planner's short way past the bookkeeping of ``reset(set_state=True)`` and ``step``.

        Args:
            state (TensorDictBase): the env's ``state_spec``, without a batch dimension.
            option (Tensor): int64, without a dimension.

        Returns:
            The outcome, or None where ``reset`` and ``step`` are needed.
        """
        fit = self._fitted()
        if not fit.alone or self.trajectory is not None:
            return None
        fit = fit.for_planning()
        with torch.no_grad():
            root = fit.set_state(state)
            root.set(self.skill_key, option)
            fit.act(root)
            return self._run_alone(fit, root, fit.step(root))

    def _run_alone(
        self, fit: WorkerEnv, root: TensorDictBase, after: TensorDictBase
    ) -> TensorDictBase:
        """Continue in an env of one state, whose rows need no masks."""
        first = after.get(fit.reward_key)
        # Sums of one number: numpy takes a twentieth of torch's time, and rounds as it does.
        number = np.float64 if first.dtype == torch.float64 else np.float32
        reward = number(first.item())
        carried = fit.carried(root, after)
        discount, taken = 1.0, 1
        while taken < self.max_steps and not self._has_ended(fit, root, after, taken):
            discount *= self.gamma
            root = self._advance(fit, root, after, carried)
            after = fit.step(root)
            reward += number(discount) * number(after.get(fit.reward_key).item())
            taken += 1
        dtype = first.dtype if first.is_floating_point() else torch.float32
        total = torch.full_like(first, float(reward), dtype=dtype)
        duration = torch.full((1,), taken, dtype=torch.int64, device=first.device)
        return self._finish(fit, after, total, duration, None)

    def _has_ended(
        self, fit: WorkerEnv, root: TensorDictBase, after: TensorDictBase, taken: int
    ) -> bool:
        if self.termination is None and len(fit.done_keys) == 1:
            return bool(after.get(fit.done_keys[0]))
        return bool(self._ended(fit, root, after, taken))

    def _run_locked(
        self,
        fit: WorkerEnv,
        root: TensorDictBase,
        after: TensorDictBase,
        skipped: Tensor | None,
    ) -> TensorDictBase:
        """Continue in an env of fixed batch size; ``_step`` tells it whom to leave alone."""
        batch_size = after.batch_size
        out = after.clone()
        reward = out.get(fit.reward_key).clone()
        running = torch.ones(batch_size, dtype=torch.bool, device=reward.device)
        if skipped is not None:
            running &= ~skipped
        trajectory = self._begin_trajectory(fit, root, after, running)
        carried = fit.carried(root, after)
        last = fit.durations(after)
        duration = running.unsqueeze(-1) * last  # [*B, 1]
        discount: float | Tensor = 1.0
        for taken in range(1, self.max_steps):
            passed = taken if isinstance(last, int) else duration
            running = running & ~self._ended(fit, root, out, passed)
            if not running.any():
                break
            discount = discount * power(self.gamma, last)
            root = self._advance(fit, root, out, carried)
            if batch_size and not running.all():
                root.set("_step", running)
            after = fit.step(root)
            root = root.exclude("_step")
            gained = discounted(after.get(fit.reward_key), discount)
            reward = torch.where(expand_as_right(running, reward), reward + gained, reward)
            last = fit.durations(after)
            duration = duration + running.unsqueeze(-1) * last
            out = after.clone() if running.all() else _where(running, after, out)
            if trajectory is not None:
                trajectory.write(taken, running, root, after)
        return self._finish(fit, out, reward, duration, trajectory)

    def _advance(
        self, fit: WorkerEnv, root: TensorDictBase, after: TensorDictBase, carried: list[NestedKey]
    ) -> TensorDictBase:
        """The next root: what the env wrote becomes its input, and the worker acts on it."""
        root = fit.step_mdp(root, after, carried)
        fit.act(root)
        return root

    def _ended(
        self, fit: WorkerEnv, root: TensorDictBase, after: TensorDictBase, passed: int | Tensor
    ) -> Tensor:
        shape = after.batch_size
        ended = after.get(fit.done_keys[0]).reshape(*shape, -1).any(-1)
        for key in fit.done_keys[1:]:
            ended = ended | after.get(key).reshape(*shape, -1).any(-1)
        if self.termination is not None:
            seen = after.copy()
            seen.set(self.skill_key, root.get(self.skill_key))
            if isinstance(passed, int):
                passed = torch.full((*shape, 1), passed, device=ended.device)
            seen.set(self.duration_key, passed)
            ended = ended | self._asked(self.termination(seen), shape)
        return ended

    def _asked(self, ends: Tensor, shape: torch.Size) -> Tensor:
        good = isinstance(ends, Tensor) and ends.dtype == torch.bool
        if not good or ends.shape not in (shape, (*shape, 1)):
            got = f"{ends.dtype} {list(ends.shape)}" if isinstance(ends, Tensor) else repr(ends)
            raise ValueError(
                f"The termination {getattr(self.termination, '__name__', self.termination)!s} must "
                f"return bool {list(shape)} or {[*shape, 1]}, True where the option ends; it "
                f"returned {got}."
            )
        return ends.reshape(shape)

    def _begin_trajectory(
        self,
        fit: WorkerEnv,
        root: TensorDictBase,
        after: TensorDictBase,
        running: Tensor | None = None,
    ) -> OptionTrajectory | None:
        if self.trajectory is None:
            return None
        trajectory = self.trajectory.start(fit.trajectory_spec, after.batch_size)
        trajectory.write(0, running, root, after)
        return trajectory

    def _finish(
        self,
        fit: WorkerEnv,
        out: TensorDictBase,
        reward: Tensor,
        duration: Tensor,
        trajectory: OptionTrajectory | None,
    ) -> TensorDictBase:
        if fit.unannounced:
            out = out.exclude(*fit.unannounced)
        fit.masks.hide(out)
        out.set(fit.reward_key, reward)
        out.set(self.duration_key, duration)
        if trajectory is not None:
            out.set(OptionTrajectory.KEY, trajectory.data)
        return out

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        return tensordict if tensordict is None else self._fitted().masks.show(tensordict.copy())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._fitted().masks.hide(tensordict_reset)
        shape, device = tensordict_reset.batch_size, tensordict_reset.device
        zero = torch.zeros((*shape, 1), dtype=torch.int64, device=device)
        tensordict_reset.set(self.duration_key, zero)
        if self.trajectory is not None:
            empty = self.trajectory.start(self._fitted().trajectory_spec, shape)
            tensordict_reset.set(OptionTrajectory.KEY, empty.data)
        return tensordict_reset

    def _skill(self, option: Tensor, shape: torch.Size, batch_size: torch.Size) -> Tensor:
        shape = batch_size + shape[len(self.parent.batch_size) :]
        if self.one_hot:
            shape = torch.Size((*shape, self.num_options))
        if option.shape != shape or not (self.one_hot or option.dtype == torch.int64):
            raise ValueError(
                f"The option under {self.option_key!r} must be "
                f"{'one-hot' if self.one_hot else 'int64'} {list(shape)}; got {option.dtype} "
                f"{list(option.shape)}. env.rand_action(td) writes one of the right form."
            )
        if self.one_hot:
            wrong = option.sum(-1) != 1
            if wrong.any():
                raise ValueError(
                    f"The option under {self.option_key!r} must be one-hot {list(shape)}; got "
                    f"{option[wrong][0].tolist()}. Set exactly one entry."
                )
            return option.to(torch.int64).argmax(-1)
        if option.numel():
            low, high = torch.aminmax(option)
            if low < 0 or high >= self.num_options:
                bad = int(low) if low < 0 else int(high)
                raise ValueError(
                    f"Option {bad} does not exist: options are 0 to {self.num_options - 1}. Choose "
                    f"one of them, or make OptionTransform with a larger num_options."
                )
        return option

    # ---------------------------------------------------------------- specs

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        self._fitted()
        input_spec = input_spec.clone()
        old = input_spec["full_action_spec"]
        shape, device = self._fitted().option_shape, old.device
        option: TensorSpec
        if self.one_hot:
            option = OneHot(self.num_options, shape=(*shape, self.num_options), device=device)
        else:
            option = Categorical(self.num_options, shape=shape, device=device)
        spec = Composite(shape=old.shape, device=device)
        for group in _groups(self.option_key):  # a group of agents keeps its shape
            spec[group] = Composite(shape=shape, device=device)
        spec[self.option_key] = option
        input_spec["full_action_spec"] = spec
        masks = self._fitted().masks
        state = input_spec.get("full_state_spec", None)
        if state is not None:
            masks.hide_specs(state)
        if not self._fitted().batch_locked and state is not None and not state.is_empty():
            # The first step reads and hands out what the env showed: a stored state needs it.
            observed = self.parent.full_observation_spec
            handed = () if self.trajectory is None else self.trajectory.keys
            for key in map(unravel_key, (*getattr(self.worker, "in_keys", ()), *handed)):
                above = masks.name(key)
                if key in observed.keys(True, True) and above not in state.keys(True, True):
                    state[above] = observed[key].clone()
        return input_spec

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        reward_spec = reward_spec.clone()
        key = self._fitted().reward_key
        leaf = reward_spec[key]
        reward_spec[key] = Unbounded(shape=leaf.shape, dtype=leaf.dtype, device=leaf.device)
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = self._fitted().masks.hide_specs(observation_spec.clone())
        shape, device = observation_spec.shape, observation_spec.device
        observation_spec[self.duration_key] = Bounded(
            0,
            self._fitted().most_base_steps(self.max_steps),
            shape=(*shape, 1),
            dtype=torch.int64,
            device=device,
        )
        if self.trajectory is not None:
            spec = self._fitted().trajectory_spec
            observation_spec[OptionTrajectory.KEY] = spec
        return observation_spec

    def set_container(self, container: Transform | EnvBase) -> None:
        """Takes its place in an env, and checks there that worker and env fit."""
        self._fit = None
        super().set_container(container)
        if self.parent is not None:  # None in a Compose that has no env yet
            self._fitted()

    def reset_parent(self) -> None:
        """Forgets the env it was part of."""
        self._fit = None
        super().reset_parent()

    def empty_cache(self) -> None:
        """Forgets what it knows of the env, e.g. after a transform was put in front."""
        self._fit = None  # e.g. a transform was put in front, and the parent is another
        super().empty_cache()

    def __getstate__(self) -> dict[str, object]:
        return {**super().__getstate__(), "_fit": None}

    def _fitted(self) -> WorkerEnv:
        if self._fit is None:
            parent = self.parent
            if parent is None:
                raise RuntimeError(
                    "OptionTransform runs its worker in an env and has none. Use it as "
                    "TransformedEnv(env, OptionTransform(...)); it has no meaning in a replay "
                    "buffer."
                )
            self._fit = WorkerEnv(self)
        return self._fit

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Not defined: an option can be run in an env only."""
        raise RuntimeError(
            "OptionTransform cannot be applied to data: running an option needs an env. Append it "
            "to a TransformedEnv, and store the macro transitions that env gives."
        )

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(num_options={self.num_options}, max_steps={self.max_steps}, "
            f"gamma={self.gamma})"
        )


def _groups(key: NestedKey) -> list[NestedKey]:
    return [] if isinstance(key, str) else [unravel_key(key[:-1])]


def _where(mask: Tensor, new: TensorDictBase, old: TensorDictBase) -> TensorDictBase:
    return torch.where(mask, new.select(*old.keys(True, True)), old)

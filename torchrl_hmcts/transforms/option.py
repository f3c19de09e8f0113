"""Options: a worker's rollout as one step of a macro environment.

Letters: *B batch of the tensordict, T ``max_steps``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, Transform

from torchrl_hmcts.checks import (
    instance,
    nested_key,
    no_class,
    one_of,
    real_number,
    whole_number,
)
from torchrl_hmcts.nesting import parts
from torchrl_hmcts.transforms.env_transform import EnvTransform, zero_count
from torchrl_hmcts.transforms.option_checks import Termination, check_skill_table
from torchrl_hmcts.transforms.option_rollout import OptionRollout
from torchrl_hmcts.transforms.trajectory import OptionTrajectory

_ROOT = "_option_root_"


class OptionTransform(EnvTransform):
    r"""Makes each rollout of a worker one macro-step, so that a planner or a loss works on an SMDP.

    The action of the transformed env is an **option**. One step runs the worker closed-loop in the
    base env, until the option's termination, ``max_steps`` base steps or ``done``. With
    :math:`r_{i+1}` the base rewards and :math:`k` the base steps taken, it writes

    .. math:: \text{reward} = \sum_{i<k} \gamma^i\, r_{i+1}, \qquad \text{duration} = k,

    the done flags, and observation and state after the last base step. Every batch element has its
    own option and its own end. If the env below counts base steps itself, as one with an
    OptionTransform does, k is their sum: there can be any number of levels.
    :func:`~torchrl_hmcts.objectives.use_durations` makes any TorchRL loss correct for the SMDP.

    The base env's ``"action_mask"`` forbids base actions; above, it is ``"base_action_mask"``, and
    a transform behind this one may write a mask of the options, e.g. :class:`SkillMaskTransform`.

    Append it after all transforms that must see base steps. The worker is no sub-module: its owner
    moves, trains and saves it. The memory of a recurrent worker is what it writes under ``"next"``.
    TorchRL's ``LowLevelController`` is such a worker: append its ``make_tensordict_primer()``
    before this transform, and name its decision ``skill_key``.

    With a group of agents and ``option_key=("agents", "option")`` each agent has an option and its
    own reward; their options begin and end together, as soon as one of them ends.

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
        option_key (NestedKey): the macro action, int64 ``[*B]``; ``[*B, n]`` in a group of agents.
            With ``"action"`` every TorchRL actor, loss and trainer fits without ``set_keys``.
        skill_key (NestedKey): the entry from which the worker reads the option, int64 ``[*B]``, or
            a vector of ``skills``, ``[*B, D]``.
        duration_key (NestedKey): base steps taken, int64 ``[*B, 1]``.
        trajectory_keys (sequence of NestedKey, optional): entries of base transitions to return,
            of the env or of the worker, e.g. ``"position"``, ``"action_log_prob"`` or ``("next",
            "reward")``: as ``("next", "trajectory", ...)`` ``[*B, T]``, zero after the option's
            end, with ``("next", "trajectory", "mask")``. Default: none.
        base_duration_key (NestedKey, optional): in which the env below counts the base steps of
            each of its steps, int64 ``[*B, 1]``. Default: that of its ``OptionTransform``, else
            ``duration_key`` or ``"duration"``, if it has one; without, each step is a base step.
        worker_memory (str): memory of a recurrent worker at the start of an option: ``"reset"``
            (default), that of its primer, or zeros; ``"keep"``, that at the end of the last option,
            which a ``TensorDictPrimer`` before this transform must keep.
        skills (Tensor, optional): ``[num_options, D]``, the vector that the worker gets for each
            option, e.g. of :func:`~torchrl_hmcts.modules.spread_skills`. Default: its number.

    Raises:
        ValueError: when attached, if worker and env do not fit, or the env cannot leave elements
            alone whose option has ended; when stepping, if an option does not exist, or the
            termination returns anything but one bool each.

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

    worker: TensorDictModuleBase
    termination: Termination | None
    skills: Tensor | None

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
        trajectory_keys: Sequence[NestedKey] | None = None,
        base_duration_key: NestedKey | None = None,
        worker_memory: Literal["reset", "keep"] = "reset",
        skills: Tensor | None = None,
    ) -> None:
        for name, part in (("worker", worker), ("termination", termination)):
            no_class("OptionTransform", name, part)
            if not callable(part) and (part is not None or name == "worker"):
                raise ValueError(
                    f"OptionTransform needs a {name} that it can call on a tensordict; got "
                    f"{part!r}."
                )
        self.option_key = nested_key("OptionTransform", "option_key", option_key)
        self.skill_key = nested_key("OptionTransform", "skill_key", skill_key)
        self.duration_key = nested_key("OptionTransform", "duration_key", duration_key)
        self.base_duration_key = None
        if base_duration_key is not None:
            self.base_duration_key = nested_key(
                "OptionTransform", "base_duration_key", base_duration_key
            )
        super().__init__(in_keys=[], out_keys=[self.duration_key])
        # Not sub-modules: an env must not put its owner's worker into eval mode or onto its device.
        self.__dict__["worker"] = worker
        self.__dict__["termination"] = termination
        self.num_options = whole_number("OptionTransform", "num_options", num_options, least=1)
        self.max_steps = whole_number("OptionTransform", "max_steps", max_steps, least=1)
        self.gamma = real_number("OptionTransform", "gamma", gamma, above=0.0, most=1.0)
        self.worker_memory = one_of(
            "OptionTransform", "worker_memory", worker_memory, ("reset", "keep")
        )
        self.register_buffer("skills", check_skill_table(skills, self.num_options))
        self.trajectory = None
        if trajectory_keys is not None:
            instance("OptionTransform", "trajectory_keys", trajectory_keys, list, tuple)
            keys = [nested_key("OptionTransform", "trajectory_keys", k) for k in trajectory_keys]
            self.trajectory = OptionTrajectory(keys, self.max_steps)
        self._rollout: OptionRollout | None = None

    def told(self, option: Tensor) -> Tensor:
        """Return what the worker gets for options, int64 ``[*B]``: themselves or vectors."""
        return option if self.skills is None else self.skills.to(option.device)[option]

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose the first base action; the env then takes that step as it always does."""
        rollout = self._attached()
        option = tensordict.get(self.option_key, None)
        if option is None:
            raise KeyError(
                f"OptionTransform found no option under {self.option_key!r}. Write it with a "
                f"planner or policy, or with env.rand_action(td)."
            )
        private = [key for key in tensordict.keys() if str(key).startswith(_ROOT)]
        inner = rollout.masks.show(tensordict).exclude("_step", "next", *private)
        inner = inner.copy()  # groups too: a transform below may rename what is in them
        self._check_option(option, rollout.option_shape, tensordict.batch_size)
        inner.set(self.skill_key, self.told(option))
        if self.worker_memory == "reset":
            rollout.begin_memory(inner)
        with torch.no_grad():
            rollout.act(inner)
        for key in (self.skill_key, *rollout.worker_writes):
            tensordict.set(key, inner.get(key))
        # For _step: all that the worker wrote, as it wrote it.
        return tensordict.set(self._root_key, inner)

    @property
    def _root_key(self) -> str:
        return f"{_ROOT}{id(self)}"  # its own: another OptionTransform may stand below

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        rollout = self._attached()
        skipped = tensordict.get("_step", None)
        if skipped is not None:
            skipped = ~skipped.reshape(next_tensordict.batch_size)
        root = tensordict.get(self._root_key).exclude(self.option_key)
        if "next" in tensordict.keys():  # of an earlier step from this root: TorchRL copies it over
            next_tensordict = next_tensordict.select(*rollout.written)
        kept = root.get("next", None)
        if kept is not None:  # the memory with which a recurrent worker continues
            next_tensordict.update(kept.select(*rollout.memory))
        return rollout.run(root, next_tensordict, skipped)

    def run_from(self, state: TensorDictBase, option: Tensor) -> TensorDictBase | None:
        """Run an option, int64 ``[]``, from a state; what ``step`` writes as next.

        A planner's short way past ``reset(set_state=True)`` and ``step``, for an env of one state;
        None where these are needed.
        """
        return self._attached().run_from(state, option)

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        return tensordict if tensordict is None else self._attached().masks.show(tensordict.copy())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        rollout = self._attached()
        rollout.masks.hide(tensordict_reset)
        tensordict_reset.set(self.duration_key, zero_count(tensordict_reset))
        if self.trajectory is not None:
            empty = self.trajectory.start(rollout.trajectory_spec, tensordict_reset.batch_size)
            tensordict_reset.set(OptionTrajectory.KEY, empty.data)
        return tensordict_reset

    def _check_option(self, option: Tensor, shape: torch.Size, batch_size: torch.Size) -> None:
        shape = batch_size + shape[len(self.parent.batch_size) :]
        if option.shape != shape or option.dtype != torch.int64:
            raise ValueError(
                f"The option under {self.option_key!r} must be int64 {list(shape)}; got "
                f"{option.dtype} {list(option.shape)}. env.rand_action(td) writes one that fits."
            )
        if option.numel():
            low, high = torch.aminmax(option)
            if low < 0 or high >= self.num_options:
                bad = int(low) if low < 0 else int(high)
                raise ValueError(
                    f"Option {bad} does not exist: options are 0 to {self.num_options - 1}. Choose "
                    f"one of them, or make OptionTransform with a larger num_options."
                )

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        rollout = self._attached()
        input_spec = input_spec.clone()
        old = input_spec["full_action_spec"]
        shape, device = rollout.option_shape, old.device

        spec = Composite(shape=old.shape, device=device)
        group = parts(self.option_key)[:-1]
        if group:  # of agents, which keeps its shape
            spec[unravel_key(group)] = Composite(shape=shape, device=device)
        spec[self.option_key] = Categorical(self.num_options, shape=shape, device=device)
        input_spec["full_action_spec"] = spec
        state = input_spec.get("full_state_spec", None)
        if state is None:
            return input_spec
        rollout.masks.hide_specs(state)
        if not (rollout.batch_locked or state.is_empty()):
            # The first step reads and hands out what the env showed: a stored state needs it.
            observed = self.parent.full_observation_spec
            handed = () if self.trajectory is None else self.trajectory.keys
            for key in map(unravel_key, (*getattr(self.worker, "in_keys", ()), *handed)):
                above = rollout.masks.renamed.get(key, key)
                if key in observed.keys(True, True) and above not in state.keys(True, True):
                    state[above] = observed[key].clone()
        return input_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        reward_spec = reward_spec.clone()
        key = self._attached().reward_key
        leaf = reward_spec[key]
        reward_spec[key] = Unbounded(shape=leaf.shape, dtype=leaf.dtype, device=leaf.device)
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        rollout = self._attached()
        spec = rollout.masks.hide_specs(observation_spec.clone())
        most, shape = rollout.most_base_steps, (*spec.shape, 1)
        spec[self.duration_key] = Bounded(
            0, most, shape=shape, dtype=torch.int64, device=spec.device
        )
        if self.trajectory is not None:
            spec[OptionTrajectory.KEY] = rollout.trajectory_spec
        return spec

    def set_container(self, container: Transform | EnvBase) -> None:
        """Takes its place in an env, and checks there that worker and env fit."""
        self._rollout = None
        super().set_container(container)
        if self.parent is not None:  # None in a Compose that has no env yet
            self._attached()

    def reset_parent(self) -> None:
        """Forgets the env it was part of."""
        self._rollout = None
        super().reset_parent()

    def empty_cache(self) -> None:
        """Forgets what it knows of the env, e.g. after a transform was put in front."""
        self._rollout = None
        super().empty_cache()

    def __getstate__(self) -> dict[str, object]:
        return {**super().__getstate__(), "_rollout": None}

    def _attached(self) -> OptionRollout:
        """Return its rollout in the env that it is part of now."""
        if self._rollout is None:
            if self.parent is None:
                raise RuntimeError(
                    "OptionTransform runs its worker in an env and has none. Use it as "
                    "TransformedEnv(env, OptionTransform(...)); it has no meaning in a replay "
                    "buffer."
                )
            self._rollout = OptionRollout(self)
        return self._rollout

"""Checks of a planner's simulator: an env that the planner would misread is refused."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torchrl.data import Categorical, OneHot, TensorSpec
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_hmcts.checks import nested_key
from torchrl_hmcts.nesting import env_name, flat_transforms


def check_env(env: EnvBase) -> None:
    """Refuse an env that cannot be set to a state, or has no state or several actions."""
    if not isinstance(env, EnvBase):
        raise TypeError(
            f"MCTSPlanner plans in a TorchRL env; got {env!r:.60}. Make one of a Gymnasium env or "
            "its id: SettableGymEnv(env)."
        )
    name = env_name(env)
    if env.batch_locked and not env._supports_set_state:
        raise ValueError(
            f"MCTSPlanner needs an env it can set to any state; {name} cannot "
            f"(_supports_set_state=False, batch_locked=True). Make a Gymnasium env by "
            f"SettableGymEnv(its id). Of others use a stateless one, e.g. WaterworldMazeEnv(), or "
            f"one whose reset(td, set_state=True) restores the state in td. If all that its step "
            f"reads is in the tensordict already, declare it by StatelessSimulator(env)."
        )
    if len(env.action_keys) != 1:
        raise ValueError(
            f"MCTSPlanner chooses one option per step; {name} has the actions {env.action_keys}. "
            "Make one discrete action of them, e.g. by an OptionTransform around a worker."
        )
    if not list(env.full_state_spec.keys(True, True)):
        raise ValueError(
            f"{name} has an empty state_spec, so its state cannot be stored in a tree. Declare "
            f"in state_spec every entry that its _step reads or that reset(td, set_state=True) "
            f"restores (for TorchRL's MujocoEnv qpos and qvel, by a transform)."
        )


def count_options(env: EnvBase, spec: TensorSpec) -> int:
    """Return the number of values of the env's action, which must be one discrete number."""
    boxes = getattr(spec.space, "boxes", [spec.space])  # the Multi specs have one per entry
    shape = spec.shape[:-1] if isinstance(spec, OneHot) else spec.shape
    single = len(boxes) == 1 and _one_number(shape, env)
    if not isinstance(spec, (Categorical, OneHot)) or not single:
        raise ValueError(
            f"MCTSPlanner searches one discrete action; {env_name(env)} has {spec}. Put the env "
            f"under an OptionTransform, or discretise its action with torchrl's ActionDiscretizer."
        )
    return int(boxes[0].n)


def check_rewards_and_ends(
    env: EnvBase, reward_key: NestedKey, done_keys: tuple[NestedKey, NestedKey]
) -> None:
    """Refuse rewards and ends that a search would misread."""
    reward = env.full_reward_spec[reward_key]
    if not _one_number(reward.shape, env) or reward.dtype.is_complex:
        raise ValueError(
            f"MCTSPlanner plans for one reward, a real number per step; the reward "
            f"{reward_key!r} of {env_name(env)} is {_described(reward, env)}. Make one number of "
            f"it, e.g. by torchrl's LineariseRewards or a transform of your own."
        )
    for key in done_keys:
        done = env.full_done_spec[key]
        if not _one_number(done.shape, env) or done.dtype != torch.bool:
            raise ValueError(
                f"MCTSPlanner needs one end per state, a bool [1]; {key!r} of {env_name(env)} is "
                f"{_described(done, env)}. Reduce it, e.g. by any(-1, keepdim=True), in a "
                f"transform."
            )


def check_durations_and_masks(
    env: EnvBase, duration_key: NestedKey | None, mask_key: NestedKey | None, num_options: int
) -> None:
    """Refuse durations and masks that a search would misread."""
    shown = env.full_observation_spec
    if duration_key is not None:
        duration = shown[duration_key]
        integer = not (duration.dtype.is_floating_point or duration.dtype.is_complex)
        if not _one_number(duration.shape, env) or not integer or duration.dtype == torch.bool:
            raise ValueError(
                f"MCTSPlanner reads the base steps of a step, an int64 [1], from "
                f"{duration_key!r}; in {env_name(env)} that is {_described(duration, env)}. Name "
                f"another entry by duration_key, or None if every step is one."
            )
    if mask_key is not None:
        mask = shown[mask_key]
        if mask.shape[env.batch_dims :].numel() != num_options:
            raise ValueError(
                f"MCTSPlanner reads which of the {num_options} options may be taken, bool "
                f"[{num_options}], from {mask_key!r}; in {env_name(env)} that is "
                f"{_described(mask, env)}. Name the options' own mask by mask_key, or None if "
                f"all may be taken."
            )
        below = _masks_actions_below_options(env, mask_key)
        if below:
            raise ValueError(
                f"MCTSPlanner reads which options may be taken from {mask_key!r}, but in "
                f"{env_name(env)} this is the mask of the {below} base actions, written before the "
                "OptionTransform. Write a mask of the options in a transform after it, or pass "
                "mask_key=None."
            )


def check_state(td: TensorDictBase, keys: Sequence[NestedKey]) -> None:
    """Refuse a state to plan from that lacks an entry, or has one that is not finite."""
    missing = [key for key in keys if td.get(key, None) is None]
    if missing:
        raise ValueError(
            f"The state to plan from lacks {missing}. Pass a tensordict as env.reset() or "
            f'env.step(td)["next"] gives it; this one has '
            f"{sorted(map(str, td.keys(True, True)))}."
        )
    for key in keys:
        value = td.get(key)
        if value.is_floating_point() and not torch.isfinite(value).all():
            bad = value[~torch.isfinite(value)][0].item()
            raise ValueError(
                f'The state to plan from has "{key}" = {bad}. A state that is not finite '
                f"cannot be simulated; find the step that wrote it."
            )


def check_masks(masks: np.ndarray, done: np.ndarray, roots: np.ndarray) -> None:
    """Refuse roots whose episode continues though no option may be taken."""
    stuck = roots[~(masks.any(-1) | done)] if len(masks) else roots[:0]
    if len(stuck):
        raise ValueError(
            f"Root {stuck[0]} has no option that may be taken: its action mask is all False. "
            f"Plan from a state that is not a dead end, or mark it as done."
        )


def find_reward_key(env: EnvBase, reward_key: NestedKey | None) -> NestedKey:
    """Return the key of the reward: the given one, or the only one."""
    keys = [unravel_key(k) for k in env.reward_keys]
    if reward_key is not None:
        reward_key = nested_key("MCTSPlanner", "reward_key", reward_key)
        if reward_key in keys:
            return reward_key
    if reward_key is not None or len(keys) != 1:
        raise ValueError(
            f"MCTSPlanner plans for one reward; {env_name(env)} has {keys}, and reward_key is "
            f"{reward_key!r}. Name one of them, e.g. reward_key={keys[0]!r}."
        )
    return keys[0]


def _masks_actions_below_options(env: EnvBase, mask_key: NestedKey) -> int:
    """The number of base actions if the mask is theirs, not a transform's behind the options."""
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


def find_done_keys(env: EnvBase) -> tuple[NestedKey, NestedKey]:
    """Return the entries that mark the last state of an episode, and a terminal one."""
    keys = [unravel_key(k) for k in env.done_keys]
    ends = [k for k in keys if _last(k) == "done"]
    if "done" not in ends and len(ends) != 1:
        raise ValueError(
            f"MCTSPlanner needs one entry that says that an episode is over; {env_name(env)} has "
            f'{ends}. Write "done" in a transform, e.g. True where all of them are True.'
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

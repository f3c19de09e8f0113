"""The env below an OptionTransform: how it is found, what it must be able to do."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Any

import torch
from tensordict import unravel_key
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
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

from torchrl_hmcts.carried_state import CarriedFrames, apart
from torchrl_hmcts.nesting import flat_transforms

_SPECS = (
    *("action_spec", "full_action_spec", "action_keys", "action_key", "input_spec"),
    *("reward_spec", "full_reward_spec", "reward_keys", "reward_key", "output_spec"),
    *("observation_spec", "full_observation_spec", "state_spec", "full_state_spec"),
    *("done_spec", "full_done_spec", "done_keys", "batch_size", "device", "_is_batched"),
)

if TYPE_CHECKING:
    from torchrl_hmcts.transforms.option import OptionTransform


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


def env_below(transform: Transform) -> TransformedEnv:
    """Return the env below a transform, stepped by the transforms themselves.

    TorchRL makes it of copies, so that what a transform learns or counts in the steps inside an
    option, e.g. ``VecNormV2``, would be lost to the one that is saved and frozen. Only the frames
    of ``CatFrames`` are carried in the tensordict instead, since rows come and go.
    """
    parent = apart(transform.parent)
    copies, live = flat_transforms(parent), transforms_before(transform)
    kept = [c if isinstance(c, CarriedFrames) else t for c, t in zip(copies, live, strict=True)]
    if kept:
        parent.transform.transforms = nn.ModuleList(kept)
    return parent


def transforms_before(transform: Transform) -> list[Transform]:
    """Return the transforms of an env before a transform, those within a Compose too.

    Found from the transform upwards: its env may not have it yet.
    """
    before: list[Transform] = []
    inside, container = transform, transform.__dict__["_container"]()
    while isinstance(container, Compose):
        parts = list(container.transforms)
        parts = parts[: [part is inside for part in parts].index(True)]
        before = [t for part in parts for t in _flat(part)] + before
        inside, container = container, container.__dict__["_container"]()
    return before


def _flat(transform: Transform) -> list[Transform]:
    """The transforms within a transform, first to last."""
    if not isinstance(transform, Compose):
        return [transform]
    return [part for inner in transform.transforms for part in _flat(inner)]


def with_constant_specs(env: EnvBase) -> EnvBase:
    """Return a shallow copy of an env whose specs are attributes of its class."""
    kind = type(env)
    folded = {name: getattr(env, name) for name in _SPECS if hasattr(kind, name)}
    view = copy(env)
    view.__class__ = type(kind.__name__, (kind,), folded)
    return view


def check_holds_elements(env: EnvBase) -> None:
    """Refuse an env of several elements that steps or resets them all at once."""
    parts: list[Transform] = []
    while isinstance(env, TransformedEnv):
        parts += flat_transforms(env)
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


def check_after(transform: Transform) -> None:
    """Refuse a FrameSkipTransform after the options: it repeats them without discount."""
    container = transform.__dict__["_container"]()
    behind = False
    for part in _flat(container) if isinstance(container, Compose) else ():
        if behind and isinstance(part, FrameSkipTransform):
            raise ValueError(
                "FrameSkipTransform after an OptionTransform would add up the rewards of options "
                "without discount and count the base steps of the last one only. Put it before the "
                "OptionTransform, or repeat options by a second OptionTransform, whose worker "
                f"writes the option again: max_steps={part.frame_skip}."
            )
        behind = behind or part is transform


def duration_key(env: EnvBase, transform: OptionTransform) -> NestedKey | None:
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
            for part in reversed(flat_transforms(below))
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


def group_shape(env: EnvBase, option_key: NestedKey) -> torch.Size:
    """The shape of the options: that of the group of agents in which they are, or the batch's."""
    specs: Composite = env.full_action_spec
    group = () if isinstance(option_key, str) else option_key[:-1]
    if group and unravel_key(group) in specs.keys(True):
        return specs[unravel_key(group)].shape
    return env.batch_size

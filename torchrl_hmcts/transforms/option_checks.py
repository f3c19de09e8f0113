"""Checks of the env below an OptionTransform (Any: it imports this file) and of its worker."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.envs import (
    AutoResetTransform,
    Compose,
    EnvBase,
    FrameSkipTransform,
    TensorDictPrimer,
    TransformedEnv,
    VecGymEnvTransform,
)
from torchrl.envs.gym_like import GymLikeEnv
from torchrl.envs.transforms import Transform

from torchrl_hmcts.carried_state import CarriedFrames, apart
from torchrl_hmcts.nesting import env_name, flat_transforms, innermost, parts

Termination = Callable[[TensorDictBase], Tensor]
_SPECS = (
    *("action_spec", "full_action_spec", "action_keys", "action_key", "input_spec"),
    *("reward_spec", "full_reward_spec", "reward_keys", "reward_key", "output_spec"),
    *("observation_spec", "full_observation_spec", "state_spec", "full_state_spec"),
    *("done_spec", "full_done_spec", "done_keys", "batch_size", "device", "_is_batched"),
)


def check_skill_table(skills: Tensor | None, num_options: int) -> Tensor | None:
    """Return a copy of a table of skills, if it has a vector for each option."""
    if skills is None:
        return None
    good = isinstance(skills, Tensor) and skills.ndim == 2 and skills.is_floating_point()
    if not good or len(skills) != num_options or not skills.isfinite().all():
        got = f"{skills.dtype} {list(skills.shape)}" if isinstance(skills, Tensor) else skills
        raise ValueError(
            f"OptionTransform needs for skills a table of finite floats, a vector for each of the "
            f"{num_options} options: [{num_options}, D]; got {got!r}."
        )
    return skills.detach().clone()


def transforms_before(transform: Transform) -> list[Transform]:
    """Return the transforms before one, found upwards: its env may not have it yet."""
    before: list[Transform] = []
    inside, container = transform, transform.__dict__["_container"]()
    while isinstance(container, Compose):
        siblings = list(container.transforms)
        siblings = siblings[: [part is inside for part in siblings].index(True)]
        before = [t for part in siblings for t in flat_transforms(part)] + before
        inside, container = container, container.__dict__["_container"]()
    return before


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


def with_constant_specs(env: EnvBase) -> EnvBase:
    """Return a shallow copy of an env whose specs are attributes of its class."""
    kind = type(env)
    folded = {name: getattr(env, name) for name in _SPECS if hasattr(kind, name)}
    view = copy(env)
    view.__class__ = type(kind.__name__, (kind,), folded)
    return view


def check_env(transform: Any, env: TransformedEnv) -> None:
    """Refuse an env whose rewards or steps cannot be summed, or whose parts read missing
    entries."""
    base = env_name(env)
    if len(env.reward_keys) != 1:
        raise ValueError(
            f"OptionTransform sums one reward; {base} has the rewards {env.reward_keys}. Reduce "
            "them to one with a transform before it."
        )
    if transform.max_steps > 1:
        _check_holds_elements(env)
    _check_after(transform)
    written = {*env.full_observation_spec.keys(True, True), *env.state_keys}
    written |= {*env.done_keys, env.reward_keys[0], transform.skill_key, transform.duration_key}
    available = set(map(unravel_key, written))
    for key in getattr(transform.termination, "in_keys", ()):
        if unravel_key(key) not in available:
            raise ValueError(
                f"The termination {type(transform.termination).__name__} reads {key!r}, which a "
                f"base step of {base} does not write: it writes {sorted(map(str, available))}. Put "
                f"a transform that writes {key!r} before OptionTransform."
            )


def _check_holds_elements(env: EnvBase) -> None:
    """Refuse an env of several elements that steps or resets them all at once."""
    transforms: list[Transform] = []
    while isinstance(env, TransformedEnv):
        transforms += flat_transforms(env)
        env = env.base_env
    resets = any(isinstance(t, (AutoResetTransform, VecGymEnvTransform)) for t in transforms)
    n = env.batch_size.numel()
    if n > 1 and (resets or isinstance(env, GymLikeEnv)):
        raise ValueError(
            "OptionTransform makes elements whose option has ended wait for the others. "
            f"{type(env).__name__} steps and resets all its {n} elements at once, so they cannot "
            f"wait. Make {n} envs of one element: SerialEnv({n}, make_env) or ParallelEnv({n}, "
            "make_env)."
        )


def _check_after(transform: Transform) -> None:
    """Refuse a FrameSkipTransform after the options: it repeats them without discount."""
    container = transform.__dict__["_container"]()
    together = flat_transforms(container) if isinstance(container, Compose) else [transform]
    behind = together[[part is transform for part in together].index(True) :]
    for part in behind:
        if isinstance(part, FrameSkipTransform):
            raise ValueError(
                "FrameSkipTransform after an OptionTransform would add up the rewards of options "
                "without discount and count the base steps of the last one only. Put it before the "
                "OptionTransform, or repeat options by a second OptionTransform, whose worker "
                f"writes the option again: max_steps={part.frame_skip}."
            )


def duration_key(transform: Any, env: EnvBase) -> NestedKey | None:
    """Return the entry in which the env below counts base steps, if it does."""
    spec = env.full_observation_spec
    available = set(map(unravel_key, spec.keys(True, True)))
    told = transform.base_duration_key
    if told is not None and told not in available:
        raise ValueError(
            f"OptionTransform reads base steps from {told!r}, which {env_name(env)} does not "
            f"write; it writes {sorted(map(str, available))}."
        )
    names = [] if told is None else [told]
    below = env
    while not names and isinstance(below, TransformedEnv):
        options = [t for t in flat_transforms(below) if hasattr(t, "num_options")]
        names = [t.duration_key for t in reversed(options) if hasattr(t, "duration_key")][:1]
        below = below.base_env
    for name in (*names, transform.duration_key, "duration"):
        counts = name in available and spec[name].dtype in (torch.int32, torch.int64)
        if counts and spec[name].shape[-1:] == (1,):
            return name
    return None


def group_shape(env: EnvBase, option_key: NestedKey) -> torch.Size:
    """Return the shape of the options: that of their group of agents, or the batch's."""
    group = parts(option_key)[:-1]
    if group and unravel_key(group) in env.full_action_spec.keys(True):
        shape: torch.Size = env.full_action_spec[unravel_key(group)].shape
        return shape
    return env.batch_size


class Trial(NamedTuple):
    """What a worker did when it was tried."""

    root: TensorDictBase
    """Entries of a root after the worker has acted."""
    writes: list[NestedKey]
    """What it wrote into the root."""
    memory: dict[NestedKey, Tensor]
    """The memory of a recurrent worker, written under ``"next"``: its beginning, of one element."""
    unannounced: list[NestedKey]
    """What of its memory the env does not announce."""


def try_worker(transform: Any, env: TransformedEnv) -> Trial:
    """Run the worker once, and refuse one that does not fit the env."""
    worker, base = transform.worker, env_name(env)
    name = f"The worker {type(worker).__name__}"
    td = env.fake_tensordict().exclude("next", *env.action_keys)
    skill = torch.zeros(
        group_shape(env, transform.option_key), dtype=torch.int64, device=env.device
    )
    td.set(transform.skill_key, transform.told(skill))
    _check_skills(name, transform)
    known = getattr(worker, "num_skills", None)
    if isinstance(known, int) and known < transform.num_options:
        raise ValueError(
            f"{name} has {known} skills, but there are {transform.num_options} options. Make "
            f"OptionTransform with num_options={known}, or a worker with more."
        )
    outputs = map(unravel_key, getattr(worker, "out_keys", ()))
    own = {unravel_key(key[1:]) for key in outputs if parts(key)[0] == "next"}
    for key in getattr(worker, "in_keys", ()):
        if td.get(key, None) is None and unravel_key(key) not in own:
            raise ValueError(
                f"{name} reads {key!r}, which {base} does not have: it has "
                f"{sorted(map(str, td.keys(True, True)))}. Change the worker's in_keys, or add a "
                f"transform that writes {key!r} before OptionTransform; if it is the option, pass "
                f"skill_key={key!r}."
            )
    before = {key: id(value) for key, value in td.items(True, True)}
    with torch.no_grad(), torch.random.fork_rng(devices=[]):  # the check draws no numbers
        try:
            worker(td)
        except (KeyError, AttributeError) as error:
            if isinstance(error, AttributeError) and not hasattr(worker, "make_tensordict_primer"):
                raise
            raise ValueError(
                f"{name} reads an entry that {base} does not have: {error}. If it is the worker's "
                "memory, append its make_tensordict_primer() before OptionTransform."
            ) from error
    _check_actions(name, env, td)
    writes = [
        key
        for key, value in td.items(True, True)
        if parts(key)[0] != "next" and before.get(key) != id(value)
    ]
    memory = _find_memory(env, td)
    shown = set(map(unravel_key, env.full_observation_spec.keys(True, True)))
    lost = [key for key in memory if key not in shown]
    if lost and transform.worker_memory == "keep":
        raise ValueError(
            f"{name} keeps {lost} from one option to the next, but {base} does not pass it on. "
            "Append the worker's make_tensordict_primer() before OptionTransform, or pass "
            "worker_memory='reset'."
        )
    return Trial(td, writes, memory, lost)


def _check_skills(name: str, transform: Any) -> None:
    """Refuse a worker that needs vectors and gets numbers, or needs numbers and gets vectors."""
    spec, table = getattr(transform.worker, "skill_spec", None), transform.skills
    decisions = getattr(transform.worker, "decision_spec", None)  # of TorchRL's LowLevelController
    if isinstance(decisions, Composite):
        spec = decisions.get(parts(transform.skill_key)[-1], None)
    if not isinstance(spec, TensorSpec) or spec.shape == (() if table is None else table.shape[1:]):
        return
    told = "their numbers" if table is None else f"vectors of {table.shape[-1]} numbers"
    known = "numbers" if not spec.ndim else f"vectors of {spec.shape[-1]} numbers"
    raise ValueError(
        f"{name} knows skills as {known}, but gets options as {told}. Pass OptionTransform "
        + (
            f"skills=, a table [{transform.num_options}, {spec.shape[-1]}], e.g. "
            f"spread_skills(spec, {transform.num_options})."
            if spec.ndim
            else "no skills=, so that the worker gets the options' numbers."
        )
    )


def _check_actions(name: str, env: EnvBase, td: TensorDictBase) -> None:
    for key in env.action_keys:
        action, spec = td.get(key, None), env.full_action_spec[key]
        if action is None:
            raise ValueError(
                f"{name} wrote no {key!r}, the action of {env_name(env)}. Give it "
                f"out_keys=[{key!r}]."
            )
        if action.shape != spec.shape or action.dtype != spec.dtype or not spec.is_in(action):
            raise ValueError(
                f"{name} wrote {key!r} = {action.dtype} {list(action.shape)} with values up to "
                f"{action.max().item():g}, which does not fit the env's action spec {spec}. Build "
                "the worker from env.action_spec."
            )


def _find_memory(env: EnvBase, td: TensorDictBase) -> dict[NestedKey, Tensor]:
    """Return the first values of the memory that the worker wrote under "next"; the root has them.

    They are those that the env's primers write at a reset, or zeros.
    """
    kept, ndim = td.get("next", None), len(env.batch_size)
    below = set(map(unravel_key, innermost(env).full_observation_spec.keys(True, True)))
    wrote = {} if kept is None else {unravel_key(k): v for k, v in kept.items(True, True)}
    wrote = {key: value for key, value in wrote.items() if key not in below}
    fresh = env.fake_tensordict().exclude("next", *wrote) if wrote else td
    primers = flat_transforms(env) if wrote and isinstance(env, TransformedEnv) else []
    with torch.random.fork_rng(devices=[]):
        for primer in primers:
            if isinstance(primer, TensorDictPrimer) and not primer.random:
                fresh = primer._reset(fresh, fresh)
    memory = {}
    for key, value in wrote.items():
        begins = fresh.get(key, None)
        begins = torch.zeros_like(value) if begins is None else begins
        memory[key] = begins.reshape(-1, *value.shape[ndim:])[0].clone()
        if td.get(key, None) is None:
            td.set(key, begins)
    return memory

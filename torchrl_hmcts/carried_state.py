"""Transforms that keep a state outside the tensordict, and what a planner does about them.

What a transform remembers in itself, e.g. the last frames, is not set with a state: frames of other
nodes would leak into a node, and frames of simulated steps into the env that is acted in.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import (
    CatFrames,
    Compose,
    EnvBase,
    InitTracker,
    NoopResetEnv,
    RandomTruncationTransform,
    TimeMaxPool,
    Transform,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)
from torchrl.envs.transforms import RNDTransform
from torchrl.record import TensorDictRecorder, VideoRecorder

from torchrl_hmcts.nesting import env_name, envs_below, flat_transforms, given, parts

_RECORDERS = (VideoRecorder, TensorDictRecorder)


class CarriedFrames(CatFrames):
    """CatFrames whose last frames are its own output in the tensordict, and not in a buffer."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            frame, stack = next_tensordict.get(in_key), tensordict.get(out_key)
            size = frame.size(self.dim)
            older = stack.narrow(self.dim, size, stack.size(self.dim) - size)
            next_tensordict.set(out_key, torch.cat((older, frame), self.dim))
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            stack = given(tensordict, out_key)
            if stack is None:
                frame = tensordict_reset.get(in_key)
                older = [frame] * (self.N - 1)
                if self.padding == "constant":
                    older = [torch.full_like(frame, self.padding_value)] * (self.N - 1)
                stack = torch.cat((*older, frame), self.dim)
            tensordict_reset.set(out_key, stack)
        return tensordict_reset

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        stacked = self.transform_observation_spec(self.parent.full_observation_spec.clone())
        for key in self.out_keys:
            state_spec[key] = stacked[key].clone()
        return state_spec


class CarriedInit(InitTracker):
    """InitTracker of any number of states, which need not be the batch of the env."""

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for init_key in self.init_keys:
            if next_tensordict.get(init_key, None) is None:
                done = next_tensordict.get((*parts(init_key)[:-1], "done"))
                next_tensordict.set(init_key, torch.zeros_like(done))
        return next_tensordict


def carried(transform: Transform) -> Transform:
    """Return a copy of a transform for another env; of CatFrames, one that keeps no buffer."""
    if isinstance(transform, CatFrames):
        return CarriedFrames(
            transform.N,
            transform.dim,
            in_keys=transform.in_keys,
            out_keys=transform.out_keys,
            padding=transform.padding,
            padding_value=transform.padding_value,
            reset_key=transform.__dict__.get("_reset_key"),
        )
    if isinstance(transform, InitTracker):
        return CarriedInit(transform.init_key)
    copy = transform.clone()
    copy.reset_parent()
    if _is_foreign(transform):  # what it keeps stays in one place, for both envs
        for name in ("_step", "_call", "_inv_call"):
            copy.__dict__[name] = getattr(transform, name)
    return copy


def apart(env: EnvBase, *, recorders: bool = True) -> EnvBase:
    """Return an env whose CatFrames and InitTracker are of any states; without them, as it is.

    With ``recorders=False`` TorchRL's recorders are left out.
    """
    if not isinstance(env, TransformedEnv):
        return env
    base, transforms = apart(env.base_env, recorders=recorders), flat_transforms(env)
    kept = [t for t in transforms if recorders or not isinstance(t, _RECORDERS)]
    keep_state = (CatFrames,) if env.batch_locked else (CatFrames, InitTracker)
    carry = (CarriedFrames, CarriedInit)
    replaced = any(isinstance(t, keep_state) and not isinstance(t, carry) for t in kept)
    if base is env.base_env and len(kept) == len(transforms) and not replaced:
        return env
    if type(env) is not TransformedEnv:
        raise ValueError(
            "A planner copies the transforms of an env that has CatFrames, InitTracker or a "
            f"recorder. It cannot copy {_name(env)}. Use a plain TransformedEnv."
        )
    return TransformedEnv(base, Compose(*map(carried, kept)), auto_unwrap=False)


def planning_env(env: EnvBase) -> EnvBase:
    """Return an env to plan in, which shares with ``env`` no state of a transform.

    Raises:
        ValueError: if a transform keeps a state that cannot be set, and which.
    """
    _refuse_states(env, inside=None)
    plan = apart(env, recorders=False)  # simulated steps are not to be filmed
    shown = set(map(unravel_key, plan.full_observation_spec.keys(True, True)))
    for transforms in map(flat_transforms, _layers(plan)):
        for i, frames in enumerate(transforms):
            for key in frames.out_keys if isinstance(frames, CarriedFrames) else ():
                behind = [t for t in transforms[i + 1 :] if key in t.out_keys]
                if behind or unravel_key(key) not in shown:
                    what = f"is written again by {_name(behind[0])}" if behind else "is taken away"
                    raise ValueError(
                        "MCTSPlanner sets the frames of CatFrames by their stack, the entry "
                        f"{key!r}. It {what} after CatFrames. Keep it in the observation: let "
                        "later transforms write another key, or move them before CatFrames."
                    )
    return plan


def _refuse_states(env: EnvBase, inside: str | None) -> None:
    """Raise a ValueError that names the first transform whose state cannot be set."""
    for transform in flat_transforms(env) if isinstance(env, TransformedEnv) else ():
        reason = _reason(transform, env, inside)
        if reason is not None:
            raise ValueError(
                f"MCTSPlanner sets {env_name(env)} to states of the tensordict, but its "
                f"{_name(transform)} keeps a state elsewhere: it {reason}."
            )
    for below in envs_below(env):
        _refuse_states(below, inside if isinstance(env, TransformedEnv) else _name(env))


def _reason(transform: Transform, env: EnvBase, inside: str | None) -> str | None:
    """Tell what a transform keeps that cannot be set, and what to do; None if nothing."""
    if isinstance(transform, (VecNorm, VecNormV2)) and not transform.frozen:
        return "learns its statistics from every step. Freeze it first: its freeze()"
    if isinstance(transform, VecNormV2):
        reduces = transform.reduce_batch_dims or not transform.stateful
        if not (reduces or env.batch_locked) and env.batch_size.numel() != 1:
            return (
                "has statistics for each element of the batch, and a wave has other states. Make "
                "it with reduce_batch_dims=True"
            )
    if isinstance(transform, RNDTransform) and transform.training:
        if transform.normalize_obs or transform.normalize_reward:
            return "learns its statistics from every step. Stop that first: its eval()"
    if isinstance(transform, TimeMaxPool):
        return (
            "keeps the last observations. Stack them by CatFrames, which a planner can set, and "
            "take the maximum over the stack in a transform behind it"
        )
    if isinstance(transform, RandomTruncationTransform):
        return "draws a horizon for each episode and keeps it. Use StepCounter(max_steps=...)"
    if isinstance(transform, NoopResetEnv) and env.batch_locked:
        return "steps the env after a reset, away from the state that it was set to. Leave it out"
    if isinstance(transform, CatFrames) and inside is not None:
        return f"keeps its frames inside {inside}. Append it to that instead"
    return None


def _layers(env: EnvBase) -> Iterator[TransformedEnv]:
    """Yield the TransformedEnvs on the way to the env below all transforms."""
    while isinstance(env, TransformedEnv):
        yield env
        env = env.base_env


class ForeignStates:
    """What transforms of other projects keep in themselves: seen to change, and put back.

    Args:
        env: whose transforms, through any nesting but that of other processes.
    """

    def __init__(self, env: EnvBase) -> None:
        transforms = [t for layer in _layers(env) for t in flat_transforms(layer)]
        self._transforms = [
            t for t in transforms if _is_foreign(t) and not isinstance(t, CatFrames)
        ]

    def read(self) -> list[dict[str, Any]]:
        """Return copies of all tensors, arrays and stacks of them that the transforms hold."""
        return [_held(transform) for transform in self._transforms]

    def changed(self, before: list[dict[str, Any]]) -> str | None:
        """Return the first attribute that is not as it was, ``"MyStack.frames"``, or None."""
        for transform, old in zip(self._transforms, before, strict=True):
            now = _held(transform)
            for name, value in old.items():
                if name in now and not _same(value, now[name]):
                    return f"{_name(transform)}.{name}"
        return None

    @contextmanager
    def unchanged(self, env: str) -> Iterator[None]:
        """Let nothing that a search does stay in the transforms of ``env``.

        Raises:
            ValueError: at the end, if a transform of another project kept something.
        """
        before, changed = self.read(), None
        try:
            yield
        finally:
            changed = self.changed(before)
            if changed is not None:  # put it back
                for transform, old in zip(self._transforms, before, strict=True):
                    for name, value in old.items():
                        setattr(transform, name, value)
        if changed is not None:
            raise ValueError(
                f"{changed} of {env} changed while MCTSPlanner searched. A transform keeps a state "
                "that a planner cannot set, so nodes of the tree would share it. Keep it in the "
                "tensordict: read it from the first argument of _step, write it to the second, "
                "and declare it in the state and observation specs."
            )


def _held(transform: Transform) -> dict[str, Any]:
    """Return copies of the tensors and arrays of a transform, and of its stacks of tensors."""
    copies: dict[type, Callable[[Any], Any]] = {
        torch.Tensor: torch.Tensor.clone,
        np.ndarray: np.ndarray.copy,
        list: list,
        deque: lambda stack: deque(stack, stack.maxlen),
    }
    own = {**transform.__dict__, **dict(transform.named_buffers(recurse=False))}
    stacks = (list, deque)  # others hold keys and the like
    return {
        name: copies[type(value)](value)
        for name, value in own.items()
        if type(value) in copies
        and (not isinstance(value, stacks) or any(isinstance(x, Tensor) for x in value))
    }


def _same(one: Any, two: Any) -> bool:
    """Whether two values are equal; stacks of another length are records, which may grow."""
    if isinstance(one, Tensor):
        return isinstance(two, Tensor) and one.shape == two.shape and torch.equal(one, two)
    if isinstance(one, np.ndarray):
        return isinstance(two, np.ndarray) and np.array_equal(one, two)
    return len(one) != len(two) or all(a is b for a, b in zip(one, two, strict=True))


def _is_foreign(transform: Transform) -> bool:
    """Whether neither TorchRL nor the transforms that run an env of their own made it."""
    package = type(transform).__module__.split(".")[0]
    return package != "torchrl" and not hasattr(transform, "num_options")


def _name(transform: Transform | EnvBase) -> str:
    return type(transform).__name__

"""A macro environment as the planner sees it: states in, outcomes of options out.

Letters: ``m`` states of one call, ``A`` options.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Categorical, OneHot
from torchrl.envs import EnvBase


class Simulator:
    """Sets a stateless macro environment to states and takes one macro-step from each of them.

    Args:
        env: the macro environment.
        extra_keys: further entries to keep with every node, for novelty tests and evaluators.
        duration_key: base steps of a macro-step.
        mask_key: options that may be taken.

    Raises:
        ValueError: if the env cannot be set to a state or has no single discrete action.
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        extra_keys: Sequence[NestedKey] = (),
        duration_key: NestedKey = "duration",
        mask_key: NestedKey = "action_mask",
    ) -> None:
        name = type(getattr(env, "base_env", env)).__name__
        if not isinstance(env, EnvBase):
            raise TypeError(
                f"MCTSPlanner plans in a TorchRL env; got {type(env).__name__}. Wrap a Gymnasium "
                f"env as described in TorchRL's GymWrapper, with a state that can be set."
            )
        if not env._supports_set_state or env.batch_locked:
            raise ValueError(
                f"MCTSPlanner needs an env it can set to any state; {name} cannot "
                f"(_supports_set_state={env._supports_set_state}, "
                f"batch_locked={env.batch_locked}). Use "
                f"one that is stateless, e.g. WaterworldMazeEnv() or GridworldMazeEnv()."
            )
        if len(env.action_keys) != 1:
            raise ValueError(
                f"MCTSPlanner chooses one option per step; {name} has the actions "
                f"{env.action_keys}."
            )
        self.env = env
        self.option_key = env.action_keys[0]
        spec = env.full_action_spec[self.option_key]
        self._one_hot = isinstance(spec, OneHot)
        self._option_dtype = spec.dtype
        boxes = getattr(spec.space, "boxes", [spec.space])  # the Multi specs have one per entry
        if not isinstance(spec, (Categorical, OneHot)) or len(boxes) != 1:
            raise ValueError(
                f"MCTSPlanner searches one discrete action; {name} has {spec}. Put the env under "
                f"an OptionTransform, or discretise its action with torchrl's ActionDiscretizer."
            )
        self.num_options = int(boxes[0].n)
        # [] for most envs, [1] under an ActionDiscretizer
        self._option_shape = () if self._one_hot else tuple(spec.shape[env.batch_dims :])
        self.state_keys = [unravel_key(k) for k in env.full_state_spec.keys(True, True)]
        if not self.state_keys:
            raise ValueError(
                f"{name} has an empty state_spec, so its state cannot be stored in a tree. Declare "
                f"in state_spec every entry that its _step reads."
            )
        available = {unravel_key(k) for k in env.full_observation_spec.keys(True, True)}
        available |= set(self.state_keys)
        extra = [unravel_key(k) for k in extra_keys]
        for key in extra:
            if key not in available:
                raise ValueError(
                    f"The novelty test or an evaluator reads {key!r}, which {name} does not have. "
                    f"Its entries: {sorted(map(str, available))}."
                )
        self.duration_key = unravel_key(duration_key) if duration_key in available else None
        self.mask_key = unravel_key(mask_key) if mask_key in available else None
        self.root_keys = list(dict.fromkeys([*self.state_keys, *extra]))
        if self.mask_key is not None:
            self.root_keys = list(dict.fromkeys([*self.root_keys, self.mask_key]))
        self._reward_key = env.reward_keys[0]
        self._done_spec = env.full_done_spec_unbatched  # a call has m states, not env.batch_size
        leaves = [unravel_key(k) for k in env.done_keys]
        self._done_key = next(k for k in leaves if _last(k) == "done")
        self._terminated_key = next((k for k in leaves if _last(k) == "terminated"), self._done_key)

    def root(self, td: TensorDictBase) -> TensorDictBase:
        """Return the root states in one batch dimension, after checking them."""
        missing = [key for key in self.root_keys if td.get(key, None) is None]
        if missing:
            raise ValueError(
                f"The state to plan from lacks {missing}. Pass a tensordict as env.reset() or "
                f'env.step(td)["next"] gives it; this one has '
                f"{sorted(map(str, td.keys(True, True)))}."
            )
        for key in self.root_keys:
            value = td.get(key)
            if value.is_floating_point() and not torch.isfinite(value).all():
                bad = value[~torch.isfinite(value)][0].item()
                raise ValueError(
                    f'The state to plan from has "{key}" = {bad}. A state that is not finite '
                    f"cannot be "
                    f"simulated; find the step that wrote it."
                )
        flat: TensorDictBase = td.reshape(-1) if len(td.batch_size) != 1 else td
        return flat

    def state(self, td: TensorDictBase) -> TensorDictBase:
        """Return the part of ``td`` from which the simulator can go on."""
        return td.select(*self.state_keys)

    def step(self, states: TensorDictBase, options: np.ndarray) -> TensorDictBase:
        """Take option ``options[i]`` in state ``i``; return what the env writes as next."""
        option = torch.from_numpy(options)
        if self.env.device is not None:
            option = option.to(self.env.device)
        states.set(self.option_key, self.encode(option))
        after = self.env._step(states)
        self.env._complete_done(self._done_spec, after)
        return after

    def encode(self, options: Tensor) -> Tensor:
        """Return option indices ``[*B]`` in the form of the env's action spec."""
        if self._one_hot:
            return torch.nn.functional.one_hot(options, self.num_options).to(self._option_dtype)
        return options.reshape((*options.shape, *self._option_shape))

    def rewards(self, after: TensorDictBase) -> np.ndarray:
        """Return the rewards, float32 ``[m]``."""
        rewards: np.ndarray = (
            after.get(self._reward_key).to(torch.float32).cpu().reshape(-1).numpy()
        )
        if not np.isfinite(rewards).all():
            raise ValueError(
                f"The simulator returned a reward of {rewards[~np.isfinite(rewards)][0]}. Rewards "
                f"must be finite; find the state from which the env wrote it."
            )
        return rewards

    def done(self, td: TensorDictBase) -> np.ndarray:
        """Return which states end the episode, bool ``[m]``; False where a root does not say.

        A rollout marks the elements it no longer steps with ``"_step"`` False and fills them with
        zeros, which are no state to plan from: they have ended too.
        """
        done = self._flag(td, self._done_key)
        stepped = td.get("_step", None)
        return done if stepped is None else done | ~stepped.cpu().reshape(-1).numpy()

    def terminated(self, td: TensorDictBase) -> np.ndarray:
        """Return which states are terminal, bool ``[m]``."""
        return self._flag(td, self._terminated_key)

    def durations(self, after: TensorDictBase) -> np.ndarray:
        """Return base steps per macro-step, int64 ``[m]``."""
        if self.duration_key is None:
            return np.ones(after.batch_size[0], np.int64)
        durations: np.ndarray = after.get(self.duration_key).cpu().reshape(-1).numpy()
        return durations

    def masks(self, td: TensorDictBase) -> np.ndarray:
        """Return which options may be taken, bool ``[m, A]``, or ``[0, A]`` for all."""
        if self.mask_key is None:
            return np.zeros((0, self.num_options), np.bool_)
        mask: np.ndarray = td.get(self.mask_key).cpu().reshape(-1, self.num_options).numpy()
        return mask

    def _flag(self, td: TensorDictBase, key: NestedKey) -> np.ndarray:
        flag = td.get(key, None)
        if flag is None:
            return np.zeros(td.batch_size[0], np.bool_)
        array: np.ndarray = flag.cpu().reshape(-1).numpy()
        return array


def _last(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]

"""Tiny environments with known solutions, with which to test a planner, worker or loss.

Letters: *B batch of the tensordict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase


class _TinyEnv(EnvBase):
    """Stateless, batched and settable; its entry ``"state"`` is its whole state."""

    batch_locked = False
    _supports_set_state = True

    def _begin(self, tensordict: TensorDictBase | None, start: int, set_state: bool) -> TensorDict:
        """Return the states that a reset gives, those that were asked for or ``start``."""
        shape = self.batch_size if tensordict is None else tensordict.batch_size
        state = torch.full(shape, start, dtype=torch.int64, device=self.device)
        if set_state and tensordict is not None:
            state = tensordict.get("state").clone()
        return TensorDict(state=state, batch_size=shape, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


class TableEnv(_TinyEnv):
    """A deterministic (semi-)Markov decision process given by its table of transitions.

    Stateless, batched and settable: ``"state"`` (int64 ``[*B]``) is its whole state. With
    durations other than 1 it is a macro environment by itself.

    Args:
        transitions: ``{(state, action): (next_state, reward, duration)}``; all states and actions
            from 0 up. A pair that is missing is an action that may not be taken there.
        terminal: states that end an episode.
        truncated: states that cut an episode off, as a time limit does. With them the env also
            writes ``"truncated"``.
        start: state after a reset. Default 0.
        device: of all tensors. Default: CPU.

    Raises:
        ValueError: if the table is empty or a state leads nowhere and is not terminal.

    Example:
        >>> env = TableEnv({(0, 0): (1, 2.0, 3), (0, 1): (1, 1.0, 1)}, terminal=[1])
        >>> td = env.step(env.reset().set("action", torch.tensor(0)))
        >>> td["next", "reward"].item(), td["next", "duration"].item(), td["next", "done"].item()
        (2.0, 3, True)
    """

    gamma = 0.99  # per base step: what a planner takes where it is told nothing else

    def __init__(
        self,
        transitions: Mapping[tuple[int, int], tuple[int, float, int]],
        *,
        terminal: Sequence[int] = (),
        truncated: Sequence[int] = (),
        start: int = 0,
        device: torch.device | str | None = None,
    ) -> None:
        if not transitions:
            raise ValueError("TableEnv needs at least one transition; the table is empty.")
        super().__init__(device=device, batch_size=[])
        num_states = 1 + max(max(s, row[0]) for (s, _), row in transitions.items())
        num_states = max(num_states, 1 + max([*terminal, *truncated], default=0), 1 + start)
        num_actions = 1 + max(a for _, a in transitions)
        self.start = start
        self._next_state = torch.zeros(num_states, num_actions, dtype=torch.int64, device=device)
        self._reward = torch.zeros(num_states, num_actions, device=device)
        self._duration = torch.ones(num_states, num_actions, dtype=torch.int64, device=device)
        self._allowed = torch.zeros(num_states, num_actions, dtype=torch.bool, device=device)
        for (state, action), (next_state, reward, duration) in transitions.items():
            self._next_state[state, action] = next_state
            self._reward[state, action] = reward
            self._duration[state, action] = duration
            self._allowed[state, action] = True
        self._terminal = torch.zeros(num_states, dtype=torch.bool, device=device)
        self._terminal[list(terminal)] = True
        self._truncated = torch.zeros(num_states, dtype=torch.bool, device=device)
        self._truncated[list(truncated)] = True
        self._ends = self._terminal | self._truncated
        self._writes_truncated = bool(truncated)
        stuck = ~self._allowed.any(-1) & ~self._ends
        if stuck.any():
            raise ValueError(
                f"State {int(stuck.nonzero()[0])} has no transition and is not terminal. Add one, "
                f"or name it in terminal={list(terminal)}."
            )
        self.state_spec = Composite(state=Categorical(num_states, shape=(), device=device))
        self.observation_spec = Composite(
            state=Categorical(num_states, shape=(), device=device),
            action_mask=Binary(num_actions, dtype=torch.bool, device=device),
            duration=Unbounded((1,), dtype=torch.int64, device=device),
        )
        self.action_spec = Categorical(num_actions, shape=(), device=device)
        self.reward_spec = Unbounded((1,), device=device)
        self.done_spec = Composite(
            {
                key: Binary(1, dtype=torch.bool, device=device)
                for key in ("done", "terminated", *(["truncated"] if truncated else []))
            }
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, action = tensordict.get("state"), tensordict.get("action")
        next_state = self._next_state[state, action]
        done = self._ends[next_state].unsqueeze(-1)
        entries = {
            "state": next_state,
            "action_mask": self._allowed[next_state] | done,
            "duration": self._duration[state, action].unsqueeze(-1),
            "reward": self._reward[state, action].unsqueeze(-1),
            "terminated": self._terminal[next_state].unsqueeze(-1),
            "done": done,
        }
        if self._writes_truncated:
            entries["truncated"] = self._truncated[next_state].unsqueeze(-1)
        return TensorDict(entries, batch_size=tensordict.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        td = self._begin(tensordict, self.start, kwargs.get("set_state", False))
        td.set("action_mask", self._allowed[td["state"]] | self._ends[td["state"]].unsqueeze(-1))
        duration = torch.zeros((*td.batch_size, 1), dtype=torch.int64, device=self.device)
        return td.set("duration", duration)


class ChainEnv(_TinyEnv):
    """Walk along a chain of states; the right end terminates with reward 1.

    Action 0 goes left (and stays at state 0), action 1 goes right. Stateless, batched and settable:
    ``"state"`` (int64 ``[*B]``) is its whole state. The best return is ``gamma ** (length - 2)``.

    Args:
        length: number of states, at least 2.
        reward_per_step: further reward of every step. Default 0.
        batch_size: copies that ``reset()`` makes. Default none.
        device: of all tensors. Default: CPU.

    Raises:
        ValueError: if ``length`` is below 2.

    Example:
        >>> env = ChainEnv(length=3)
        >>> td = env.rollout(5, policy=lambda td: td.set("action", torch.tensor(1)))
        >>> td["next", "reward"].flatten().tolist()
        [0.0, 1.0]
    """

    def __init__(
        self,
        length: int = 5,
        *,
        reward_per_step: float = 0.0,
        batch_size: Sequence[int] = (),
        device: torch.device | str | None = None,
    ) -> None:
        if length < 2:
            raise ValueError(f"ChainEnv needs at least 2 states; got length={length}.")
        super().__init__(device=device, batch_size=torch.Size(batch_size))
        self.length = length
        self.reward_per_step = reward_per_step
        shape = self.batch_size
        state = Bounded(0, length - 1, shape=shape, dtype=torch.int64, device=device)
        self.state_spec = Composite(state=state.clone(), shape=shape)
        self.observation_spec = Composite(state=state, shape=shape)
        self.action_spec = Categorical(2, shape=shape, device=device)
        self.reward_spec = Unbounded((*shape, 1), device=device)
        done = Binary(1, shape=(*shape, 1), dtype=torch.bool, device=device)
        self.done_spec = Composite(done=done, terminated=done.clone(), shape=shape)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        state = (tensordict.get("state") + 2 * tensordict.get("action") - 1).clamp_min(0)
        terminated = (state >= self.length - 1).unsqueeze(-1)
        return TensorDict(
            {
                "state": state.clamp_max(self.length - 1),
                "reward": terminated.to(torch.float32) + self.reward_per_step,
                "terminated": terminated,
                "done": terminated.clone(),
            },
            batch_size=tensordict.batch_size,
            device=self.device,
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        return self._begin(tensordict, 0, kwargs.get("set_state", False))


class PointMassEnv(EnvBase):
    r"""A point with momentum in a box, without any reward: to learn skills in.

    .. math:: v' = v + 0.05\,(4 a - 2 v), \qquad x' = x + 0.05\, v'

    with the velocity 0 along an axis on which a wall stops the point. Stateless, any batch shape,
    never done. Entries ``"position"`` (float ``[*B, 2]``, 0 to 9) and ``"velocity"``.

    Args:
        batch_size: copies that ``reset()`` makes. Default none.
        continuous: the action is the push, ``[*B, 2]`` in -1 to 1, instead of one of four: up
            (towards 0), down, left, right. Default False.

    Example:
        >>> env = PointMassEnv()
        >>> td = env.reset().set("action", torch.tensor(3))
        >>> (env.step(td)["next", "velocity"]).tolist()
        [0.20000000298023224, 0.0]
    """

    batch_locked = False
    _directions = torch.tensor([[0.0, -1.0], [0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]])

    def __init__(self, batch_size: Sequence[int] = (), *, continuous: bool = False) -> None:
        super().__init__(batch_size=torch.Size(batch_size))
        shape = self.batch_size
        spec = {
            "position": Bounded(0.0, 9.0, shape=(*shape, 2)),
            "velocity": Unbounded((*shape, 2)),
        }
        self.observation_spec = Composite(spec, shape=shape)
        self.state_spec = self.observation_spec.clone()
        if continuous:
            self.action_spec = Bounded(-1.0, 1.0, shape=(*shape, 2))
        else:
            self.action_spec = Categorical(4, shape=shape)
        self.reward_spec = Unbounded((*shape, 1))
        self.continuous = continuous
        self.generator = torch.Generator()

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self.generator.seed()
        else:
            self.generator.manual_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        shape = self.batch_size if tensordict is None else tensordict.batch_size
        position = 9.0 * torch.rand((*shape, 2), generator=self.generator)
        velocity = torch.zeros_like(position)
        return TensorDict({"position": position, "velocity": velocity}, batch_size=shape)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        velocity, action = tensordict["velocity"], tensordict["action"]
        push = action if self.continuous else self._directions[action]
        velocity = velocity + 0.05 * (4.0 * push - 2.0 * velocity)
        free = tensordict["position"] + 0.05 * velocity
        position = free.clamp(0.0, 9.0)
        never = torch.zeros((*tensordict.batch_size, 1), dtype=torch.bool)
        return TensorDict(
            {
                "position": position,
                "velocity": torch.where(position == free, velocity, 0.0),
                "reward": never.float(),
                "done": never,
                "terminated": never.clone(),
            },
            batch_size=tensordict.batch_size,
        )

"""Options in MiniGrid that know nothing of a task, and the env without pictures to plan in."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from torchrl_hmcts.checks import instance, whole_number
from torchrl_hmcts.envs.gym.features import STEPS, check_minigrid, is_thing

_LEFT, _RIGHT, _FORWARD = range(3)
_TURNS = (_FORWARD, _RIGHT, _RIGHT, _LEFT)  # by quarters that are missing
_DOOR, _FREE = 4, (1, 3, 8, 9)  # numbers of a door; of nothing, floor, goal and lava


class GridMoves:
    """Options of MiniGrid: go one cell right, down, left or up; pick up, drop, toggle, done.

    To go is to turn there, and to step forward unless a wall, a closed door or an object is in the
    way. The other four are one action each. ``max_steps=3`` is enough for all.

    Args:
        num_actions (int): of the env; without the last ones, fewer options. Default 7, all of them.

    Raises:
        ValueError: if ``num_actions`` is not from 3 to 7; when acting, if the observation is not
            MiniGrid's own.

    Reference:
        This project's.

    Example:
        >>> from torchrl_hmcts.envs import GridMoves, OptionPool
        >>> pool = OptionPool("MiniGrid-Empty-5x5-v0", GridMoves(), max_steps=3, num_processes=0)
        >>> td = pool.reset().set("option", 1)  # down, from a start that faces right
        >>> pool.step(td)["next", "duration"].item(), pool.step(td)["next", "direction"].item()
        (2, 1)
    """

    def __init__(self, num_actions: int = 7) -> None:
        if not 3 <= whole_number("GridMoves", "num_actions", num_actions) <= 7:
            raise ValueError(f"GridMoves needs num_actions from 3 to 7; got {num_actions}.")
        self.num_options = num_actions + 1
        self._last = _FORWARD

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> int:
        """Return the action that turns towards the option's direction, or executes it."""
        if not isinstance(observation, dict) or "direction" not in observation:
            raise ValueError(
                "GridMoves reads the direction in MiniGrid's own observation, or in that of "
                "GridView. Leave out wrappers that change it."
            )
        missing = (option - int(observation["direction"])) % 4
        self._last = _TURNS[missing] if option < 4 else option - 1
        return self._last

    def ends(self, observation: Any, option: int, steps: int) -> bool:
        """Return whether the agent has acted, or faces what it cannot enter."""
        if self._last >= _FORWARD:
            return True
        if int(observation["direction"]) != option:
            return False
        front = observation.get("front")
        if front is None:
            image = observation["image"]  # the agent is in the middle of the last row
            front = image[image.shape[0] // 2, image.shape[1] - 2]
        kind, _, state = front
        return not (kind in _FREE or (kind == _DOOR and state == 0))


class GridView(gymnasium.Wrapper):
    """A MiniGrid env to plan in: a mask of options in place of pictures.

    A picture of what the agent sees takes most of a step's time, and a search over features looks
    at none. The observation has

    - ``"action_mask"``, bool ``[A]``: which options of :class:`GridMoves` change something. To go
      where a cell can be entered, or where a door or an object is not faced yet; to pick up what
      lies in front with empty hands; to drop what is carried onto an empty cell; toggle and done
      before a door or an object;
    - ``"direction"`` of the agent and ``"front"``, the type, colour and state of what lies in front
      (uint8 ``[3]``), which :class:`GridMoves` reads.

    All else is as in the env, rewards, draws and the rows of snapshots too, so that a plan can be
    executed in one with pictures.

    Args:
        env (gymnasium.Env): a MiniGrid or BabyAI env; from now on it draws no pictures.
        moves (bool): whether the mask is of :class:`GridMoves`, or of the env's actions. Default
            True.

    Raises:
        SnapshotError: if it is another env.
        TypeError: if ``moves`` is not a bool.

    Reference:
        This project's.

    Example:
        >>> from torchrl_hmcts.envs import GridView
        >>> from torchrl_hmcts.envs.gym.settable import make_gym
        >>> env = GridView(make_gym("MiniGrid-Empty-5x5-v0"))
        >>> env.reset(seed=0)[0]["action_mask"]  # right and down
        array([ True,  True, False, False, False, False, False, False])
    """

    is_stateless = True

    def __init__(self, env: gymnasium.Env, *, moves: bool = True) -> None:
        check_minigrid(env, "GridView")
        super().__init__(env)
        inner: Any = env.unwrapped
        image = np.zeros(inner.observation_space["image"].shape, np.uint8)
        blank = {"image": image, "direction": 0, "mission": ""}
        inner.gen_obs = lambda: blank
        instance("GridView", "moves", moves, bool)
        self.moves = moves
        self._num_options = int(inner.action_space.n) + self.moves
        self.observation_space = spaces.Dict(
            {
                "action_mask": spaces.MultiBinary(self._num_options),
                "direction": spaces.Discrete(4),
                "front": spaces.Box(0, 255, (3,), np.uint8),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the env."""
        info = self.env.reset(seed=seed, options=options)[1]
        return self._observation(), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        _, reward, terminated, truncated, info = self.env.step(action)
        return self._observation(), reward, terminated, truncated, info

    def _observation(self) -> dict[str, Any]:
        inner: Any = self.env.unwrapped
        (x, y), way = inner.agent_pos, int(inner.agent_dir)
        around = [inner.grid.get(int(x) + dx, int(y) + dy) for dx, dy in STEPS]
        front, empty_handed = around[way], inner.carrying is None
        if self.moves:
            mask = [
                item is None or item.can_overlap() or (is_thing(item) and side != way)
                for side, item in enumerate(around)
            ]
        else:
            mask = [True, True, front is None or front.can_overlap()]
        thing = is_thing(front)
        mask += [
            thing and empty_handed and front.can_pickup(),
            front is None and not empty_handed,
            thing,
            thing,
        ]
        return {
            "action_mask": np.array(mask[: self._num_options], np.bool_),
            "direction": way,
            "front": np.array((1, 0, 0) if front is None else front.encode(), np.uint8),
        }

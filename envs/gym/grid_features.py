"""MiniGrid without pictures: what of a state is compared, and which actions change something."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from torchrl_hmcts.envs.gym.minigrid import _UNMOVED

_DOORS, _KINDS = 12, 18  # columns; the kinds are key, ball and box in six colours
_PLACES = 3 + _DOORS + _KINDS
_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # by direction


class GridFeatures:
    r"""Returns the pairs of the agent's pose with all else that changes in a MiniGrid env.

    With the pose :math:`p`, which is cell and direction, and another variable :math:`v_f`,

    .. math:: \phi_f = p + P\,v_f, \qquad f < F = 51

    and 0 where there is nothing of the kind. Width-1 novelty over them keeps "here with the key"
    apart from "here without it". The columns are the same in all states of all MiniGrid envs:

    ======== =======================================================================================
    columns  variable
    ======== =======================================================================================
    0        what is carried
    1-12     the state of each door, by row and column; the 13th shares the first column, and so on
    13-30    of keys, balls and boxes of each colour: how many lie where they were at first, how
             many elsewhere, how many are hidden
    31       how many doors and objects are there, and which parts of a BabyAI mission are done
    32       all of these together
    33-50    of keys, balls and boxes of each colour: the cells where they lie
    ======== =======================================================================================

    ``stages`` are the columns that a :class:`~torchrl_hmcts.planners.WidthNovelty` compares first,
    and after each relaxation: single variables, then all together, then all places.

    Args:
        None.

    Reference:
        This project's; pairs with what most actions change are a part of the width-2 search of
        Lipovetzky and Geffner, "Width and serialization of classical planning problems", 2012.

    Example:
        >>> from torchrl_hmcts.envs.gym.settable import make_gym
        >>> env = make_gym("MiniGrid-Empty-5x5-v0")
        >>> _ = env.reset(seed=0)
        >>> first = GridFeatures()(env, None)
        >>> _ = env.step(0)
        >>> (GridFeatures()(env, None) != first).nonzero()[0]
        array([ 0, 31, 32])
    """

    width = _PLACES + _KINDS
    stages = (_PLACES - 1, _PLACES)

    def __init__(self) -> None:
        self._cells: list[Any] = []
        self._doors: list[Any] = []
        self._objects: list[tuple[int, Any]] = []

    def __reduce__(self) -> Any:
        return type(self), ()

    def __call__(self, env: gymnasium.Env, observation: Any) -> np.ndarray:
        """Return the features of the present state, int64 ``[51]``."""
        inner: Any = env.unwrapped
        grid, cells = inner.grid, inner.grid.grid
        if cells != self._cells:  # by identity: two microseconds
            self._cells = cells.copy()
            things = [(i, c) for i, c in enumerate(cells) if c and c.type not in _UNMOVED]
            self._doors = [thing for _, thing in things if thing.type == "door"]
            self._objects = [(i, thing) for i, thing in things if thing.type != "door"]
        carried, doors, kinds = 0, [0] * _DOORS, [0] * _KINDS
        for i, door in enumerate(self._doors):
            doors[i % _DOORS] = 4 * doors[i % _DOORS] + 1 + door.encode()[2]
        places: list[list[int]] = [[] for _ in kinds]
        for cell, thing in self._objects:
            kind = _kind(thing)
            places[kind].append(cell)
            kinds[kind] += 64 if _is_moved(thing) else 1
            if thing.contains:
                kinds[_kind(thing.contains)] += 4096
        if inner.carrying:
            carried = 1 + _kind(inner.carrying)
            if inner.carrying.contains:
                kinds[_kind(inner.carrying.contains)] += 4096
        done = _parts_done(getattr(inner, "instrs", None))
        left = len(self._doors) + len(self._objects) + 256 * done
        x, y = inner.agent_pos
        pose = 1 + 4 * (int(x) + grid.width * int(y)) + int(inner.agent_dir)
        poses = 1 + 4 * len(cells)
        row = [pose + poses * carried]
        row += [pose + poses * value if value else 0 for value in doors]
        row += [pose + poses * value if value else 0 for value in kinds]
        row.append(pose + poses * left)
        row.append(hash((pose, carried, left, *doors, *kinds)))
        row += [hash((pose, *place)) if place else 0 for place in places]
        return np.array(row, np.int64)


class GridView(gymnasium.Wrapper):
    """A MiniGrid env for planning: features and a mask of actions in place of pictures.

    A picture of what the agent sees takes most of a step's time, and a search over features looks
    at none. The observation has ``"features"``, those of :class:`GridFeatures`, and
    ``"action_mask"``: turning is always possible; the others where what lies in front lets them
    change something: forward onto a free cell, pick up an object with empty hands, drop what is
    carried onto an empty cell, toggle and done before a door or an object. Everything else is as
    in the env, rewards and draws too, so that a plan can be executed in one with pictures.

    Args:
        env (gymnasium.Env): a MiniGrid or BabyAI env; from now on it draws no pictures.

    Reference:
        This project's.

    Example:
        >>> from torchrl_hmcts.envs.gym.settable import make_gym
        >>> env = GridView(make_gym("MiniGrid-Empty-5x5-v0"))
        >>> env.reset(seed=0)[0]["action_mask"]
        array([ True,  True,  True, False, False, False, False])
    """

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        inner: Any = env.unwrapped
        space = inner.observation_space
        blank = {"image": np.zeros(space["image"].shape, np.uint8), "direction": 0, "mission": ""}
        inner.gen_obs = lambda: blank
        self._features = GridFeatures()
        self._num_actions = int(inner.action_space.n)
        limits = np.iinfo(np.int64)
        self.observation_space = spaces.Dict(
            {
                "features": spaces.Box(limits.min, limits.max, (GridFeatures.width,), np.int64),
                "action_mask": spaces.MultiBinary(self._num_actions),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the env."""
        _, info = self.env.reset(seed=seed, options=options)
        return self._observation(), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        _, reward, terminated, truncated, info = self.env.step(action)
        return self._observation(), reward, terminated, truncated, info

    def _observation(self) -> dict[str, np.ndarray]:
        inner: Any = self.env.unwrapped
        (x, y), (dx, dy) = inner.agent_pos, _STEPS[inner.agent_dir]
        front, carrying = inner.grid.get(int(x) + dx, int(y) + dy), inner.carrying
        thing = front is not None and front.type not in _UNMOVED
        mask = (
            True,
            True,
            front is None or front.can_overlap(),
            thing and carrying is None and front.can_pickup(),
            front is None and carrying is not None,
            thing,
            thing,
        )
        return {
            "features": self._features(self.env, None),
            "action_mask": np.array(mask[: self._num_actions], np.bool_),
        }


def _kind(thing: Any) -> int:
    """The column of an object: its type and colour."""
    number, colour, _ = thing.encode()
    return (6 * (number - 5) + colour) % _KINDS


def _is_moved(thing: Any) -> bool:
    """Whether an object that lies somewhere was put there by the agent."""
    now, first = thing.cur_pos, thing.init_pos
    return now is not None and (first is None or now[0] != first[0] or now[1] != first[1])


def _parts_done(mission: Any) -> int:
    """Which parts of a BabyAI mission are done, as bits."""
    if not hasattr(mission, "instr_a"):
        return 0
    own = (mission.a_done == "success") + 2 * (mission.b_done == "success")
    return own + 4 * _parts_done(mission.instr_a) + 16 * _parts_done(mission.instr_b)

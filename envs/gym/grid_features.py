"""MiniGrid without pictures: what of a state is compared, and which actions change something."""

from __future__ import annotations

from typing import Any

import os
import gymnasium
V = os.environ.get('V', '')
import numpy as np
from gymnasium import spaces

from torchrl_hmcts.envs.gym.minigrid import _UNMOVED

_DOORS, _KINDS = 12, 18  # columns; the kinds are key, ball and box in six colours
_PLACES = 3 + _DOORS + _KINDS
_MEMORY = 1_000  # grids whose things are known
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

    def __init__(self, directed: bool = True) -> None:
        self.directed = directed
        self._known: dict[tuple[Any, ...], tuple[list[Any], list[tuple[int, Any]]]] = {}

    def __reduce__(self) -> Any:
        return type(self), (self.directed,)

    def __call__(self, env: gymnasium.Env, observation: Any) -> np.ndarray:
        """Return the features of the present state, int64 ``[51]``."""
        inner: Any = env.unwrapped
        grid, cells = inner.grid, inner.grid.grid
        doors_there, objects = self._things(cells, grid.width)
        carried, doors, kinds = 0, [0] * _DOORS, [0] * _KINDS
        for i, (door, blocked) in enumerate(doors_there):
            doors[i % _DOORS] = 8 * doors[i % _DOORS] + 1 + door.encode()[2] + 3 * blocked
        places: list[list[int]] = [[] for _ in kinds]
        for cell, thing in objects:
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
        left = len(doors_there) + len(objects) + 256 * done
        x, y = inner.agent_pos
        cell, direction = int(x) + grid.width * int(y), int(inner.agent_dir)
        full = pose = 1 + 5 * cell + 1 + direction
        if not self.directed:
            dx, dy = _STEPS[direction]
            front = cells[cell + dx + grid.width * dy]
            if front is None or front.type in _UNMOVED:
                pose = 1 + 5 * cell
        poses = 1 + 5 * len(cells)
        row = [pose + poses * carried]
        row += [pose + poses * value if value else 0 for value in doors]
        row += [pose + poses * value if value else 0 for value in kinds]
        row.append(pose + poses * left)
        joint = (full if "f" in V or ("c" in V and carried) else pose, carried, left, *doors, *kinds)
        if "e" in V:
            joint += tuple(map(tuple, places))
        row.append(hash(joint))
        q = pose if 'p' in V else full
        row += [hash((q, *place)) if place else 0 for place in places]
        return np.array(row, np.int64)

    def _things(self, cells: list[Any], width: int) -> tuple[list[Any], list[tuple[int, Any]]]:
        """The doors, and the objects with their cells, of a grid that may have been seen before."""
        known = tuple(cells)  # compared by identity, which takes a few microseconds
        if known not in self._known:
            if len(self._known) == _MEMORY:
                self._known.clear()
            things = [(i, c) for i, c in enumerate(cells) if c and c.type not in _UNMOVED]
            objects = [(i, c) for i, c in things if c.type != "door"]
            full = {i for i, _ in objects}
            doors = [
                (c, not full.isdisjoint((i - 1, i + 1, i - width, i + width)))
                for i, c in things
                if c.type == "door"
            ]
            self._known[known] = doors, objects
        return self._known[known]


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

    def __init__(self, env: gymnasium.Env, moves: bool = True) -> None:
        super().__init__(env)
        inner: Any = env.unwrapped
        space = inner.observation_space
        blank = {"image": np.zeros(space["image"].shape, np.uint8), "direction": 0, "mission": ""}
        inner.gen_obs = lambda: blank
        self._features = GridFeatures(directed=not moves).__call__  # a method: snapshots take an object for state
        self._moves = moves
        self._num_actions = int(inner.action_space.n)
        limits = np.iinfo(np.int64)
        self.observation_space = spaces.Dict(
            {
                "features": spaces.Box(limits.min, limits.max, (GridFeatures.width,), np.int64),
                "action_mask": spaces.MultiBinary(self._num_actions + moves),
                "direction": spaces.Discrete(4),
                "front": spaces.Box(0, 255, (3,), np.uint8),
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
        x, y = inner.agent_pos
        around = [inner.grid.get(int(x) + dx, int(y) + dy) for dx, dy in _STEPS]
        free = [c is None or c.can_overlap() for c in around]
        things = [c is not None and c.type not in _UNMOVED for c in around]
        way, carrying = inner.agent_dir, inner.carrying
        front, thing = around[way], things[way]
        if self._moves:
            mask = [f or (t and d != way) for d, (f, t) in enumerate(zip(free, things))]
        else:
            mask = [True, True, free[way]]
        mask += [
            thing and carrying is None and front.can_pickup(),
            front is None and carrying is not None,
            thing,
            thing,
        ]
        return {
            "features": self._features(self.env, None),
            "action_mask": np.array(mask[: self._num_actions + self._moves], np.bool_),
            "direction": int(way),
            "front": np.array((1, 0, 0) if front is None else front.encode(), np.uint8),
        }


class GridMoves:
    def __init__(self, num_actions: int = 7) -> None:
        self.num_options = num_actions + 1
        self._last = 0

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> int:
        if option >= 4:
            self._last = option - 1
        else:
            turns = (option - int(observation["direction"])) % 4
            self._last = (2, 1, 1, 0)[turns]
        return self._last

    def ends(self, observation: Any, option: int, steps: int) -> bool:
        if self._last >= 2:
            return True
        if int(observation["direction"]) != option:
            return False
        front = observation.get("front")
        if front is None:
            image = observation["image"]
            front = image[image.shape[0] // 2, image.shape[1] - 2]
        return not (front[0] in (1, 3, 8, 9) or (front[0] == 4 and front[2] == 0))


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

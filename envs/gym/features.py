"""Features: a few numbers of a state that say where it is, for novelty, skills and pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from torchrl_hmcts.checks import instance
from torchrl_hmcts.envs.gym.minigrid import _UNMOVED, MiniGridSnapshot
from torchrl_hmcts.envs.gym.mujoco import find_physics
from torchrl_hmcts.envs.gym.snapshots import SnapshotError

FEATURES_KEY = "features"
"""Entry of a tensordict that holds the features of a state."""
Features = Callable[[gymnasium.Env, Any], np.ndarray]
"""Gives the features ``[F]`` of an env's state, from the env and its observation."""


def achieved_goal(env: gymnasium.Env, observation: Any) -> np.ndarray:
    """Return what a goal is compared with, float32 ``[F]``."""
    return np.asarray(observation["achieved_goal"], np.float32)


def root_place(env: gymnasium.Env, observation: Any) -> np.ndarray:
    """Return MuJoCo's first two coordinates, the place of a robot, float32 ``[2]``."""
    inner: Any = env.unwrapped
    return inner.data.qpos[:2].astype(np.float32)


def whole_observation(env: gymnasium.Env, observation: Any, *, scale: Any = 1.0) -> np.ndarray:
    """Return the observation, each number times its scale, float32 ``[F]``; int64 without one."""
    parts = observation.values() if isinstance(observation, dict) else [observation]
    flat = [np.asarray(part).reshape(-1) for part in parts]
    whole = flat[0] if len(flat) == 1 else np.concatenate(flat)
    if scale is None:
        return whole.astype(np.int64)
    return whole.astype(np.float32) * np.float32(scale)


def features_of(env: gymnasium.Env) -> Features:
    """Return the features that suit an env.

    They are the achieved goal of an env with goals; :class:`GridFeatures` in MiniGrid; the place of
    the robot in MuJoCo; and else the observation.
    """
    space = env.observation_space
    if isinstance(space, spaces.Dict) and "achieved_goal" in space.spaces:
        return achieved_goal
    if MiniGridSnapshot.fits(env):
        turns = env.has_wrapper_attr("moves") and env.get_wrapper_attr("moves")  # of a GridView
        return GridFeatures(directed=not turns)
    try:
        model, _ = find_physics(env)
    except SnapshotError:
        return whole_observation
    free = int(model.jnt_type[0]) == 0 or list(model.jnt_type[:2]) == [2, 2]
    return root_place if free and hasattr(env.unwrapped, "data") else whole_observation


class WithFeatures(gymnasium.ObservationWrapper):
    """Shows the features beside the observation, e.g. to a vector env of Gymnasium."""

    is_stateless = True

    def __init__(self, env: gymnasium.Env, features: Features) -> None:
        super().__init__(env)
        self.features = features
        first = features(env, env.reset(seed=0)[0])
        own = env.observation_space
        parts = dict(own.spaces) if isinstance(own, spaces.Dict) else {"observation": own}
        low, high = (-np.inf, np.inf) if first.dtype.kind == "f" else (-(2**62), 2**62)
        parts[FEATURES_KEY] = spaces.Box(low, high, first.shape, first.dtype.type)
        self.observation_space = spaces.Dict(parts)

    def observation(self, observation: Any) -> dict[str, Any]:
        """Return the entries of an observation, and the features."""
        shown = observation if isinstance(observation, dict) else {"observation": observation}
        return {**shown, FEATURES_KEY: self.features(self.env, observation)}


STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Columns and rows by which the cell in front lies off, by direction."""
_DOORS, _KINDS = 12, 18  # columns; the kinds are key, ball and box in six colours
_SINGLE = 2 + _DOORS + _KINDS
_MEMORY = 1_000  # grids whose things are known


class GridFeatures:
    r"""Returns the pairs of the agent's pose with all else that changes in a MiniGrid env.

    With :math:`C` cells, the pose :math:`p < P = 5 C + 1`, which is cell and direction, and another
    variable :math:`v_f`,

    .. math:: \phi_f = p + P\,v_f, \qquad f < F = 51

    int64 ``[F]``, and 0 where there is nothing of the kind. Width-1 novelty over them keeps "here
    with the key" apart from "here without it". All MiniGrid and BabyAI envs have the same columns,
    so that the vector fits each episode:

    ======== =======================================================================================
    columns  variable
    ======== =======================================================================================
    0        what is carried: kind and colour
    1-12     of each door, row by row: open, closed or locked, and how many objects lie beside it;
             the 13th shares the first column, and so on
    13-30    of keys, balls and boxes of each colour: how many lie where they were at first, how
             many elsewhere, how many are hidden in boxes
    31       how many doors and objects are there, and which parts of a BabyAI mission are done
    32       all of these together (a hash of 64 bits)
    33-50    of keys, balls and boxes of each colour: the cells where they lie (a hash, too)
    ======== =======================================================================================

    The features that tell many states apart come last. ``stages`` are those of
    :class:`~torchrl_hmcts.planners.WidthNovelty`: single variables are compared first, then all
    together, and then the places.

    Args:
        directed (bool): the pose has the direction always. False: in the columns 0 to 32 only where
            something lies in front that can be used, for options that turn by themselves, as those
            of :class:`GridMoves` do. Default True.

    Raises:
        TypeError: if ``directed`` is not a bool.

    Reference:
        This project's; a width-2 search (Lipovetzky and Geffner, "Width and serialization of
        classical planning problems", 2012) without the pairs that have no pose in them.

    Example:
        >>> from torchrl_hmcts.envs import GridFeatures
        >>> from torchrl_hmcts.envs.gym.settable import make_gym
        >>> env, features = make_gym("MiniGrid-Empty-5x5-v0"), GridFeatures()
        >>> observation, _ = env.reset(seed=0)
        >>> first = features(env, observation)
        >>> observation = env.step(0)[0]  # to the left
        >>> (features(env, observation) != first).nonzero()[0]
        array([ 0, 31, 32])
    """

    width = _SINGLE + 1 + _KINDS
    stages = (_SINGLE, _SINGLE + 1)

    def __init__(self, directed: bool = True) -> None:
        instance("GridFeatures", "directed", directed, bool)
        self.directed = directed
        self._known: dict[tuple[Any, ...], tuple[list[Any], list[tuple[int, Any]]]] = {}

    def __reduce__(self) -> Any:
        return type(self), (self.directed,)

    def __repr__(self) -> str:
        return f"GridFeatures(directed={self.directed})"

    def __call__(self, env: gymnasium.Env, observation: Any) -> np.ndarray:
        """Return the features of the env's state, int64 ``[51]``.

        Args:
            env: a MiniGrid or BabyAI env with its wrappers.
            observation: is not read.
        """
        inner: Any = env.unwrapped
        cells, width = inner.grid.grid, inner.grid.width
        doors, objects = self._things(cells, width)
        kinds, states = [0] * _KINDS, [0] * _DOORS
        places: list[list[int]] = [[] for _ in kinds]
        for i, (door, beside) in enumerate(doors):
            state = 1 + door.encode()[2] + 3 * beside
            states[i % _DOORS] = 16 * states[i % _DOORS] + state
        for cell, thing in objects:
            kind = _kind(thing)
            places[kind].append(cell)
            kinds[kind] += 64 if _is_moved(thing) else 1
        carrying = inner.carrying
        for holder in (*(thing for _, thing in objects), carrying):
            if holder is not None and holder.contains is not None:
                kinds[_kind(holder.contains)] += 4096
        carried = 0 if carrying is None else 1 + _kind(carrying)
        there = len(doors) + len(objects) + 256 * _parts_done(getattr(inner, "instrs", None))
        x, y = inner.agent_pos
        cell, way = int(x) + width * int(y), int(inner.agent_dir)
        pose = directed = 5 * cell + 2 + way
        if not self.directed:
            dx, dy = STEPS[way]
            if not is_thing(inner.grid.get(int(x) + dx, int(y) + dy)):
                pose = 5 * cell + 1
        poses = 5 * len(cells) + 1
        row = [pose + poses * carried]
        row += [pose + poses * value if value else 0 for value in (*states, *kinds)]
        row.append(pose + poses * there)
        row.append(hash((pose, carried, there, *states, *kinds)))
        row += [hash((directed, *place)) if place else 0 for place in places]
        return np.array(row, np.int64)

    def _things(self, cells: list[Any], width: int) -> tuple[list[Any], list[tuple[int, Any]]]:
        """The doors with the number of objects beside them, and the objects with their cells.

        Grids are compared by the identity of what they hold, which takes a few microseconds.
        """
        key = tuple(cells)
        if key not in self._known:
            if len(self._known) == _MEMORY:
                self._known.clear()
            things = [(i, thing) for i, thing in enumerate(cells) if is_thing(thing)]
            objects = [(i, thing) for i, thing in things if thing.type != "door"]
            full = {i for i, _ in objects}
            doors = [
                (door, len(full & {i - 1, i + 1, i - width, i + width}))
                for i, door in things
                if door.type == "door"
            ]
            self._known[key] = doors, objects
        return self._known[key]


def check_minigrid(env: gymnasium.Env, owner: str) -> None:
    """Refuse an env that is none of MiniGrid's."""
    if not MiniGridSnapshot.fits(env):
        raise SnapshotError(
            f"{owner} is for MiniGrid and BabyAI envs, e.g. 'MiniGrid-FourRooms-v0'; got {env}."
        )


def is_thing(item: Any) -> bool:
    """Return whether a cell holds a door or an object, rather than nothing, wall, goal or lava."""
    return item is not None and item.type not in _UNMOVED


def _kind(thing: Any) -> int:
    """The column of an object: its type and colour."""
    number, colour, _ = thing.encode()
    return int(6 * (number - 5) + colour) % _KINDS


def _is_moved(thing: Any) -> bool:
    """Whether an object lies where the agent put it, and not where it was."""
    now, first = thing.cur_pos, thing.init_pos
    return now is not None and (first is None or now[0] != first[0] or now[1] != first[1])


def _parts_done(mission: Any) -> int:
    """Which parts of a BabyAI mission are done, as bits."""
    if not hasattr(mission, "instr_a"):
        return 0
    own = (mission.a_done == "success") + 2 * (mission.b_done == "success")
    return own + 4 * _parts_done(mission.instr_a) + 16 * _parts_done(mission.instr_b)

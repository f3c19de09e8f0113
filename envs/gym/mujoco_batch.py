"""Batches of MuJoCo envs that can be set to any state, and the tasks that they are stepped in.

Letters: *B batch of the tensordict, N rows, S numbers of a state, nq positions, nv velocities.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.envs.gym.mujoco import find_physics
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.envs.gym.snapshots import SnapshotError

_STATE = ("physics", "goal")


class MujocoTask:
    """Observations, rewards and ends of an env for a :class:`~torchrl_hmcts.envs.MujocoBatch`.

    A robot in a maze with a goal. Sub-classes say what differs; a task of your own is passed as
    ``task=`` and is called with the env.

    Args:
        env (gymnasium.Env): with its wrappers.

    Attributes:
        env (gymnasium.Env): the env without its wrappers.
        frame_skip (int): steps of MuJoCo in a step of the env.
        radius (float): distance from the goal that counts as reached, in metres.
        derived (tuple of str): fields of ``MjData`` that an observation holds beside positions and
            velocities.

    Reference:
        This project's.

    Example:
        >>> from torchrl_hmcts.envs import MujocoBatch, MujocoTask
        >>> class Forward(MujocoTask):  # no maze: the speed of a cheetah
        ...     frame_skip = 5
        ...     def goal(self):
        ...         return np.zeros(2)
        ...     def observe(self, qpos, qvel, derived, goal):
        ...         return {"observation": np.concatenate((qpos[:, 1:], qvel), 1)}
        ...     def judge(self, qpos, qvel, goal):
        ...         return qvel[:, 0], np.zeros(len(qpos), np.bool_)
        >>> env = MujocoBatch("HalfCheetah-v5", task=Forward, batch_size=[3])
        >>> env.rollout(2)["next", "observation"].shape
        torch.Size([3, 2, 17])
    """

    frame_skip: int
    radius: float
    derived: tuple[str, ...] = ()

    def __init__(self, env: gymnasium.Env) -> None:
        self.env: Any = env.unwrapped

    def goal(self) -> np.ndarray:
        """Return the goal of the env's episode, ``[2]``."""
        raise NotImplementedError

    def begin(self, model: Any, data: Any, action: np.ndarray) -> None:
        """Prepare MuJoCo's data, which hold a state, for the steps of an action."""
        data.ctrl[:] = action

    def observe(
        self, qpos: np.ndarray, qvel: np.ndarray, derived: np.ndarray, goal: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Return the env's observation of N states, by name.

        Args:
            qpos, qvel (ndarray): ``[N, nq]`` and ``[N, nv]``.
            derived (ndarray): the fields :attr:`derived`, side by side, ``[N, d]``.
            goal (ndarray): ``[N, 2]``.
        """
        return {"observation": np.concatenate((qpos, qvel), 1)}

    def judge(
        self, qpos: np.ndarray, qvel: np.ndarray, goal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the rewards of arriving at N states, and whether the episode ends there."""
        reached = np.linalg.norm(qpos[:, :2] - goal, axis=-1) <= self.radius
        return reached.astype(np.float64), reached


class RoboticsMaze(MujocoTask):
    """A maze of gymnasium-robotics."""

    radius = 0.45

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        if self.env.reset_target:
            raise SnapshotError(
                f"{env} draws a new goal when one is reached, so its steps depend on more than the "
                "state. Make it with reset_target=False."
            )

    def goal(self) -> np.ndarray:
        return np.array(self.env.goal)

    def judge(
        self, qpos: np.ndarray, qvel: np.ndarray, goal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        reward, reached = super().judge(qpos, qvel, goal)
        if self.env.reward_type == "dense":
            reward = np.exp(-np.linalg.norm(qpos[:, :2] - goal, axis=-1))
        return reward, reached & (not self.env.continuing_task)


class RoboticsPointMaze(RoboticsMaze):
    """Its ball, whose speed is bounded before every step."""

    frame_skip = 1

    def begin(self, model: Any, data: Any, action: np.ndarray) -> None:
        data.ctrl[:] = np.minimum(np.maximum(action, -1.0), 1.0)  # np.clip takes four times as long
        np.maximum(data.qvel, -5.0, out=data.qvel)
        np.minimum(data.qvel, 5.0, out=data.qvel)

    def observe(
        self, qpos: np.ndarray, qvel: np.ndarray, derived: np.ndarray, goal: np.ndarray
    ) -> dict[str, np.ndarray]:
        observation = np.concatenate((qpos, qvel), 1)
        return {"observation": observation, "achieved_goal": qpos, "desired_goal": goal}


class RoboticsAntMaze(RoboticsMaze):
    """Its ant, which feels the forces of contacts."""

    derived = ("cfrc_ext",)

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.frame_skip = int(self.env.ant_env.frame_skip)
        self._bounds = self.env.ant_env._contact_force_range

    def observe(
        self, qpos: np.ndarray, qvel: np.ndarray, derived: np.ndarray, goal: np.ndarray
    ) -> dict[str, np.ndarray]:
        forces = np.clip(derived[:, 6:], *self._bounds)  # the first body is the world
        observation = np.concatenate((qpos[:, 2:], qvel, forces), 1)
        return {"observation": observation, "achieved_goal": qpos[:, :2], "desired_goal": goal}


class OGBenchMaze(MujocoTask):
    """A maze of OGBench with its ant."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        kind = self.env
        simple = kind._teleport_info is None and kind._reward_task_id is None
        if not simple or kind._success_timing != "post":
            raise SnapshotError(
                f"{env} moves at random where it teleports, judges the state before a step, or "
                "pays for steps. MujocoBatch steps medium, large and giant mazes; SettableGymEnv "
                "all."
            )
        self.frame_skip = int(kind.frame_skip)
        self.radius = float(kind._goal_tol)

    def goal(self) -> np.ndarray:
        return np.array(self.env.cur_goal_xy, np.float64)

    def judge(
        self, qpos: np.ndarray, qvel: np.ndarray, goal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        reward, reached = super().judge(qpos, qvel, goal)
        return reward, reached & self.env._terminate_at_goal


class OGBenchPointMaze(OGBenchMaze):
    """Its point, which an action moves at once."""

    def begin(self, model: Any, data: Any, action: np.ndarray) -> None:
        data.qpos += 0.2 * action
        data.qvel[:] = 0.0

    def observe(
        self, qpos: np.ndarray, qvel: np.ndarray, derived: np.ndarray, goal: np.ndarray
    ) -> dict[str, np.ndarray]:
        return {"observation": qpos}


def task_of(env: gymnasium.Env) -> MujocoTask:
    """Return the task of an env that is known."""
    bases = {f"{c.__module__.split('.')[0]}.{c.__name__}" for c in type(env.unwrapped).__mro__}
    kinds: dict[type[MujocoTask], set[str]] = {
        RoboticsPointMaze: {"gymnasium_robotics.PointMazeEnv"},
        RoboticsAntMaze: {"gymnasium_robotics.AntMazeEnv"},
        OGBenchPointMaze: {"ogbench.MazeEnv", "ogbench.PointEnv"},
        OGBenchMaze: {"ogbench.MazeEnv", "ogbench.AntEnv"},
    }
    for kind, names in kinds.items():
        if names <= bases:
            return kind(env)
    raise SnapshotError(
        "MujocoBatch knows the point and ant mazes of gymnasium-robotics and OGBench, but not "
        f"{env}. Pass task=, a MujocoTask that tells its observation, reward and end; or use "
        "SettableGymEnv."
    )


class MujocoBatch(EnvBase):
    r"""Steps a batch of states of one MuJoCo env, each with the same bits as the Gymnasium env.

    .. math:: s' = \mathrm{mj\_step}^k(s, a), \qquad o = f(s'), \quad r, d = g(s')

    with k steps of MuJoCo a step of the env. The env is stateless: ``"physics"``, float64
    ``[*B, S]``, is MuJoCo's state with the solver's warm start, and ``"goal"``, float64
    ``[*B, 2]``, the maze's. Any batch can be stepped and set, so it goes under an
    :class:`~torchrl_hmcts.transforms.OptionTransform` and into a planner, and trains skills without
    a wrapper's bookkeeping. Besides it writes the observation of the Gymnasium env and
    ``"position"``, ``[*B, 2]``.

    The point and ant mazes of gymnasium-robotics and OGBench are known. Time limits are wrappers
    of Gymnasium: append TorchRL's ``StepCounter``.

    Args:
        env (str, gymnasium.Env or callable): as of
            :func:`~torchrl_hmcts.envs.gym.settable.make_gym`. It draws the starts, so do not
            use it elsewhere.
        task (callable, optional): ``task(env)`` returns a
            :class:`~torchrl_hmcts.envs.MujocoTask`. Default: that of the maze.
        num_threads (int): threads that step a batch; its rows do not depend on it. Default 1.
        dtype (torch.dtype): of observations and rewards. Default ``torch.float32``; with
            ``torch.float64`` they are Gymnasium's to the bit.
        batch_size (sequence of int): copies that ``reset()`` makes. Default none.
        seed (int, optional): of the starts. Default: drawn from torch's global generator.
        device (optional): of the tensors; the physics runs on the CPU.
        **keywords: of ``gymnasium.make``.

    Raises:
        ValueError: if the env is unknown, its task is no function of the state, or a number is out
            of range; when set to a state: if an entry is missing or of another form.

    Reference:
        Todorov, Erez and Tassa, "MuJoCo: A physics engine for model-based control", 2012. Mazes: Fu
        et al., "D4RL", 2020, arXiv 2004.07219; Park et al., "OGBench", 2024, arXiv 2410.20092.

    Example:
        >>> from torchrl_hmcts.envs import MujocoBatch
        >>> env = MujocoBatch("PointMaze_Large-v3", batch_size=[5], seed=0)
        >>> start = env.reset()
        >>> first, again = (env.step(env.reset(start.set("action", torch.ones(5, 2)),
        ...     set_state=True).set("action", torch.ones(5, 2)))["next"] for _ in range(2))
        >>> bool((first["physics"] == again["physics"]).all())
        True
    """

    batch_locked = False
    _supports_set_state = True

    def __init__(
        self,
        env: str | gymnasium.Env | Callable[[], gymnasium.Env],
        *,
        task: Callable[[gymnasium.Env], MujocoTask] = task_of,
        num_threads: int = 1,
        dtype: torch.dtype = torch.float32,
        batch_size: Sequence[int] = (),
        seed: int | None = None,
        device: Any = None,
        **keywords: Any,
    ) -> None:
        import mujoco

        theirs = {n: keywords.pop(n) for n in list(keywords) if n.startswith("_torchrl")}
        self.__dict__["gym"] = make_gym(env, **keywords)
        self.__dict__["task"] = task(self.gym)
        threads = whole_number("MujocoBatch", "num_threads", num_threads, least=1)
        super().__init__(device=device, batch_size=torch.Size(batch_size), **theirs)
        self._mj, self.model = mujoco, find_physics(self.gym)[0]
        kinds = mujoco.mjtState
        self._kind = int(kinds.mjSTATE_FULLPHYSICS) | int(kinds.mjSTATE_WARMSTART)
        self._numbers = mujoco.mj_stateSize(self.model, self._kind)
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        fields = [getattr(self._data[0], name) for name in self.task.derived]
        self._width = self._numbers + sum(field.size for field in fields)
        self._dtype = dtype
        self._set_specs()
        seed = int(torch.randint(2**31, ())) if seed is None else seed
        self.set_seed(whole_number("MujocoBatch", "seed", seed))

    # ---------------------------------------------------------------- states

    def read(self, env: gymnasium.Env) -> TensorDict:
        """Return the state of a Gymnasium env of the same kind, and what this env shows there."""
        model, data = find_physics(env)
        if (model.nq, model.nv, model.ngeom) != (self.model.nq, self.model.nv, self.model.ngeom):
            raise SnapshotError(f"{env} has another MuJoCo model than {self}.")
        goal = type(self.task)(env).goal()
        return self._shown(self._row(data), np.atleast_2d(goal), torch.Size([]))

    def _row(self, data: Any) -> np.ndarray:
        row = np.empty((1, self._width))
        self._store(data, row[0])
        return row

    def _store(self, data: Any, row: np.ndarray) -> None:
        at = self._numbers
        self._mj.mj_getState(self.model, data, row[:at], self._kind)
        for name in self.task.derived:
            field = getattr(data, name)
            row[at : at + field.size] = field.ravel()
            at += field.size

    def _advance(self, data: Any, rows: np.ndarray, actions: np.ndarray) -> None:
        """Step rows ``[N, S]`` in place, one after the other."""
        mj, model, task, numbers = self._mj, self.model, self.task, self._numbers
        for row, action in zip(rows, actions, strict=True):
            mj.mj_setState(model, data, row[:numbers], self._kind)
            task.begin(model, data, action)
            mj.mj_step(model, data, nstep=task.frame_skip)
            if task.derived:
                mj.mj_rnePostConstraint(model, data)  # as Gymnasium does after its steps
            self._store(data, row)

    def _shown(self, rows: np.ndarray, goal: np.ndarray, shape: torch.Size) -> TensorDict:
        """Pack N states with what the env shows in them."""
        nq, nv = self.model.nq, self.model.nv
        qpos, qvel = rows[:, 1 : 1 + nq], rows[:, 1 + nq : 1 + nq + nv]
        shown = self.task.observe(qpos, qvel, rows[:, self._numbers :], goal)
        entries = {"physics": torch.from_numpy(rows), "goal": torch.from_numpy(goal)}
        for name, value in {**shown, "position": qpos[:, :2]}.items():
            entries[name] = torch.tensor(value, dtype=self._dtype)
        flat = {key: value.reshape(*shape, value.shape[-1]) for key, value in entries.items()}
        return self._pack(flat, shape)

    def _pack(self, entries: dict[str, Tensor], shape: torch.Size) -> TensorDict:
        if self.device is not None and self.device.type != "cpu":
            entries = {key: value.to(self.device) for key, value in entries.items()}
        return TensorDict._new_unsafe(entries, shape, device=self.device)

    # ---------------------------------------------------------------- stepping

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        shape = self.batch_size if tensordict is None else tensordict.batch_size
        if set_state:
            return self._shown(*self._state_of(tensordict), shape)
        rows, goals = np.empty((shape.numel(), self._width)), np.empty((shape.numel(), 2))
        for i in range(len(rows)):
            self.gym.reset(seed=int(torch.randint(2**31, (), generator=self._generator)))
            self._store(find_physics(self.gym)[1], rows[i])
            goals[i] = self.task.goal()
        return self._shown(rows, goals, shape)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        rows, goals = self._state_of(tensordict)
        actions = tensordict.get("action").numpy(force=True).reshape(len(rows), -1)
        actions = actions.astype(self.gym.action_space.dtype, copy=False)
        if self._pool is None:
            self._advance(self._data[0], rows, actions)
        else:
            parts = (np.array_split(array, len(self._data)) for array in (rows, actions))
            list(self._pool.map(self._advance, self._data, *parts))
        shape = tensordict.batch_size
        after = self._shown(rows, goals, shape)
        nq, nv = self.model.nq, self.model.nv
        reward, terminated = self.task.judge(
            rows[:, 1 : 1 + nq], rows[:, 1 + nq : 1 + nq + nv], goals
        )
        ended = torch.from_numpy(terminated).reshape(*shape, 1)
        ends = {"terminated": ended, "truncated": torch.zeros_like(ended), "done": ended.clone()}
        paid = torch.from_numpy(reward).to(self._dtype).reshape(*shape, 1)
        return after.update(self._pack({"reward": paid, **ends}, shape))

    def _state_of(self, tensordict: TensorDictBase | None) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of the rows ``[N, S]`` and goals ``[N, 2]`` of states."""
        arrays = []
        for key, width in zip(_STATE, (self._width, 2), strict=True):
            value = None if tensordict is None else tensordict.get(key, None)
            if value is None or value.dtype != torch.float64 or value.shape[-1] != width:
                form = "nothing" if value is None else f"{value.dtype} {list(value.shape)}"
                raise SnapshotError(
                    f"A state has an entry {key!r}, float64 [*B, {width}]; got {form}. Pass what "
                    "reset(), step() or read(env) returned."
                )
            arrays.append(value.numpy(force=True).reshape(-1, width).copy())
        return arrays[0], arrays[1]

    # ---------------------------------------------------------------- specs and seeds

    def _set_specs(self) -> None:
        size, device, dtype = self.batch_size, self.device, self._dtype
        self.gym.reset(seed=0)
        shown = self._shown(
            self._row(find_physics(self.gym)[1]), np.atleast_2d(self.task.goal()), torch.Size([])
        )
        specs = {
            key: Unbounded(value.shape, dtype=value.dtype, device=device)
            for key, value in shown.items()
        }
        self.observation_spec = Composite(specs, device=device).expand(size)
        self.state_spec = Composite({k: specs[k].clone() for k in _STATE}, device=device).expand(
            size
        )
        space: Any = self.gym.action_space
        low, high = (
            torch.as_tensor(end, device=device).to(dtype) for end in (space.low, space.high)
        )
        action = Bounded(low, high, shape=low.shape, dtype=dtype, device=device)
        self.action_spec = action.expand(*size, *low.shape)
        self.reward_spec = Unbounded((*size, 1), dtype=dtype, device=device)
        done = {key: Binary(1, dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done, device=device).expand(size)

    def _set_seed(self, seed: int | None) -> None:
        self._generator = torch.Generator()
        if seed is None:
            self._generator.seed()
        else:
            self._generator.manual_seed(seed)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the threads and close the Gymnasium env."""
        if self._pool is not None:
            self._pool.shutdown()
        self.gym.close()
        super().close(raise_if_closed=raise_if_closed)

    def __repr__(self) -> str:
        spec = self.gym.spec
        name = spec.id if spec is not None else type(self.gym.unwrapped).__name__
        return f"{type(self).__name__}({name}, batch_size={list(self.batch_size)})"

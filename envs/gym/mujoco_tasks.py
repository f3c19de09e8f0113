"""Tasks of a MujocoBatch: a maze's observation, reward and end as functions of the physics.

Letters: N rows, nq positions, nv velocities.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from torchrl_hmcts.envs.gym.snapshots import SnapshotError


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

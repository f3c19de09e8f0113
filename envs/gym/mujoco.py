"""Snapshots of envs whose physics is MuJoCo: Gymnasium's, gymnasium-robotics', OGBench's."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from torchrl_hmcts.envs.gym.attributes import AttributeSnapshot
from torchrl_hmcts.envs.gym.snapshots import SnapshotError, env_layers

# What envs read of the last step before they take the next one: it lags behind the positions.
_DERIVED = (
    "xpos", "xquat", "xmat", "xipos", "site_xpos", "site_xmat", "geom_xpos", "cfrc_ext", "cinert",
    "cvel", "qfrc_actuator", "sensordata", "actuator_force", "subtree_com", "qacc", "ten_length",
    "actuator_length", "actuator_velocity",
)  # fmt: skip
_PROBE_STEPS = 12
# What OGBench's arms write at the beginning of each step, before they read it.
_REWRITTEN = frozenset(
    {"_prev_qpos", "_prev_qvel", "_prev_ob_info", "_prev_button_states", "_target_effector_pose"}
)
# Names and maps of a model, and what OGBench's arm solves its equations in, from nothing each time.
_NO_STATE = frozenset({"MujocoRenderer", "MujocoModelNames", "Maze", "DiffIKController"})


class MujocoSnapshot(AttributeSnapshot):
    """Stores MuJoCo's integration state, and the attributes of the env.

    Positions and velocities alone are not the state: the solver's warm start, controls and applied
    forces belong to it (``mjSTATE_INTEGRATION``). Some models also need a ``forward`` pass before
    the state is set, and some rewards read ``derived`` fields of the step before. A short probe
    finds out what of both this env needs, and fields of the model that a reset changes (goal
    sites).

    Reference:
        MuJoCo documentation, "Simulation: state and control".
    """

    skipped_attributes = AttributeSnapshot.skipped_attributes | {"observation_structure"}
    plain_types = AttributeSnapshot.plain_types | {np.ndarray}

    def __init__(self, env: gymnasium.Env, *, cap: int = 1 << 16) -> None:
        import mujoco

        self._mj = mujoco
        self.model, self.data = find_physics(env)
        self._spec = mujoco.mjtState.mjSTATE_INTEGRATION
        self._numbers = mujoco.mj_stateSize(self.model, self._spec)
        self._state = np.empty(self._numbers)
        self.forward = False
        self.derived: tuple[str, ...] = ()
        self._model_fields: tuple[str, ...] = ()
        self._attributes = 0
        self._set_views()
        super().__init__(env, cap=cap)
        self._attributes = self.width
        self._choose(env)

    @classmethod
    def fits(cls, env: gymnasium.Env) -> bool:
        return any(_physics_of(layer) is not None for layer in env_layers(env))

    def is_fixed(self, value: Any) -> bool:
        module = type(value).__module__
        return (
            module.startswith(("mujoco", "dm_control"))
            or type(value).__name__ in _NO_STATE
            or super().is_fixed(value)
        )

    def is_read(self, layer: Any, name: str) -> bool:
        ours = type(layer).__module__.startswith("ogbench.manipspace")
        return super().is_read(layer, name) and not (ours and name in _REWRITTEN)

    def read(self) -> np.ndarray:
        row = np.zeros(self.width, np.uint8)
        state = row[: 8 * self._numbers].view(np.float64)
        self._mj.mj_getState(self.model, self.data, state, self._spec)
        raw = row.data
        for memory, begin, end in self._model_parts + self._parts:
            raw[begin:end] = memory
        self._write(row[self._native :])
        return row

    def restore(self, row: np.ndarray) -> None:
        state = row[: 8 * self._numbers].view(np.float64)
        raw = row.data
        for memory, begin, end in self._model_parts:
            memory[:] = raw[begin:end]
        self._mj.mj_setState(self.model, self.data, state, self._spec)
        if self.forward:
            self._mj.mj_forward(self.model, self.data)
            self._mj.mj_setState(self.model, self.data, state, self._spec)
        for memory, begin, end in self._parts:
            memory[:] = raw[begin:end]
        self._load(row[self._native :])

    # ------------------------------------------------------------------ what an env needs

    def _set_views(self) -> None:
        self._native = 8 * self._numbers
        self._model_parts = self._parts_of(self.model, self._model_fields)
        self._parts = self._parts_of(self.data, self.derived)
        self.width = self._native + self._attributes

    def _parts_of(self, owner: Any, names: tuple[str, ...]) -> list[tuple[memoryview, int, int]]:
        """The memory of fields, and where in a row they are."""
        parts = []
        for field in [getattr(owner, name) for name in names]:
            if field.size:
                begin, self._native = self._native, self._native + field.nbytes
                parts.append((memoryview(field).cast("B"), begin, self._native))
        return parts

    def _choose(self, env: gymnasium.Env) -> None:
        """Takes the cheapest way of restoring after which the env repeats its steps to the bit."""
        models = []
        for seed in range(3):
            env.reset(seed=seed)
            models.append({n: np.array(getattr(self.model, n)) for n in ("site_pos", "body_pos")})
        changed = [n for n in models[0] if any((m[n] != models[0][n]).any() for m in models[1:])]
        self._model_fields = tuple(changed)
        env.action_space.seed(0)
        actions = [env.action_space.sample() for _ in range(3 * _PROBE_STEPS)]
        for derived, forward in (((), False), (_DERIVED, False), ((), True), (_DERIVED, True)):
            self.derived = tuple(name for name in derived if hasattr(self.data, name))
            self.forward = forward
            self._set_views()
            env.reset(seed=0)
            if self._repeats(env, actions):
                break
        else:
            raise SnapshotError(
                f"{env} does not repeat its steps after its state was restored. It is not "
                "deterministic, or has a state that no attribute shows. Pass snapshot=(read, "
                "restore) of your own."
            )

    def _repeats(self, env: gymnasium.Env, actions: list[Any]) -> bool:
        first, rest, other = (actions[i::3] for i in range(3))
        for action in first:
            env.step(action)
            self.note_step(action)
        row = self.read()
        rows = []
        for path in (rest, other, rest):
            self.restore(row)
            self.note_step(path[0])
            rows.append([repr_of(env.step(action)) for action in path])
        return rows[0] == rows[2]


def find_physics(env: gymnasium.Env) -> tuple[Any, Any]:
    """Return MuJoCo's model and data of an env."""
    for layer in env_layers(env):
        physics = _physics_of(layer)
        if physics is not None:
            return physics
    raise SnapshotError(f"{env} has no MuJoCo model and data.")


def _physics_of(layer: gymnasium.Env) -> tuple[Any, Any] | None:
    own = vars(layer)
    for model, data in (("model", "data"), ("_model", "_data")):
        if type(own.get(data)).__name__ == "MjData":
            return own[model], own[data]
    return None


def repr_of(outcome: tuple[Any, ...]) -> bytes:
    """Return a step's observation, reward and ends as bytes, to be compared to the bit."""
    observation, reward, terminated, truncated = outcome[:4]
    parts = [np.asarray(x) for x in _leaves(observation)]
    parts += [np.asarray(float(reward)), np.asarray([terminated, truncated])]
    return b"".join(part.tobytes() for part in parts)


def _leaves(observation: Any) -> list[Any]:
    if isinstance(observation, dict):
        return [leaf for key in sorted(observation) for leaf in _leaves(observation[key])]
    if isinstance(observation, tuple):
        return [leaf for item in observation for leaf in _leaves(item)]
    return [observation]

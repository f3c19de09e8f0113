"""Any Gymnasium env as a TorchRL env that can be set to a state."""

from __future__ import annotations

import contextlib
import difflib
import importlib
import io
import random
from collections.abc import Callable
from typing import Any, Literal

import gymnasium
import gymnasium.wrappers
import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Unbounded
from torchrl.envs import GymWrapper

from torchrl_hmcts import notebook
from torchrl_hmcts.checks import whole_number
from torchrl_hmcts.envs.gym.families import snapshot_of
from torchrl_hmcts.envs.gym.features import FEATURES_KEY, Features
from torchrl_hmcts.envs.gym.snapshots import (
    DEFAULT_CAP,
    SNAPSHOT_KEY,
    Snapshot,
    SnapshotError,
)

# Packages that register their envs when they are imported, and the extra that installs them.
_PACKAGES = ("gymnasium_robotics", "minigrid", "ogbench", "ale_py")


class PrivateRandom(gymnasium.Wrapper):
    """Gives an env that draws from NumPy's and Python's global generators its own states of them.

    ``reset(seed=...)`` does not fix such an env, and other draws change it. This wrapper restores
    the global generators after every reset and step, and after a ``with`` block of it. Many steps
    in one block save the time of exchanging states, 0.2 ms each.
    """

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self._outside: tuple[Any, Any] | None = None  # in a block, the states outside it
        self.seed_globals(0)

    def seed_globals(self, seed: int) -> None:
        """Seed its own states of the global generators."""
        state = np.random.RandomState(seed % 2**32).get_state()
        self._states: tuple[Any, Any] = _as_bytes(state), random.Random(seed).getstate()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the env; a seed also seeds its own states of the global generators."""
        if seed is not None:
            self.seed_globals(seed)
        return self._inside(lambda: self.env.reset(seed=seed, options=options))

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step."""
        return self._inside(lambda: self.env.step(action))

    def _inside(self, call: Callable[[], Any]) -> Any:
        if self._outside is not None:
            return call()
        with self:
            return call()

    def __enter__(self) -> PrivateRandom:
        self._outside = _global_states()
        _set_global_states(self._states)
        return self

    def __exit__(self, *error: Any) -> Literal[False]:
        assert self._outside is not None
        states = _global_states()
        if states != self._states:  # the same object says at once that nothing was drawn
            self._states = states
        _set_global_states(self._outside)
        self._outside = None
        return False


def make_gym(env: str | gymnasium.Env | Callable[[], gymnasium.Env], **keywords: Any) -> Any:
    """Make a Gymnasium env whose draws are its own.

    Args:
        env (str, gymnasium.Env or callable): an id, an env, or a function that makes one. Packages
            that are known to register envs are imported where Gymnasium does not know the id.
        **keywords: of ``gymnasium.make``.

    Returns:
        gymnasium.Env: the env, under :class:`PrivateRandom` if it draws from global generators.

    Raises:
        ValueError: if no package has the id; the nearest ids are named.
        ImportError: if the env needs a package that is not installed.

    Example:
        >>> make_gym("CartPole-v1").spec.id
        'CartPole-v1'
    """
    made = _make_id(env, keywords) if isinstance(env, str) else env
    if callable(made) and not isinstance(made, gymnasium.Env):
        made = made(**keywords)
    if not isinstance(made, gymnasium.Env):
        raise TypeError(
            "The env must be an id such as 'CartPole-v1', a gymnasium.Env or a function that "
            f"makes one; got {made!r}."
        )
    made = _with_arrays(made)
    return PrivateRandom(made) if _draws_globally(made) else made


def _with_arrays(env: gymnasium.Env) -> gymnasium.Env:
    """Leaves out observations that are no arrays, as MiniGrid's mission, and flattens tuples."""
    space = env.observation_space
    if isinstance(space, spaces.Tuple):
        return gymnasium.wrappers.FlattenObservation(env)
    if not isinstance(space, spaces.Dict):
        return env
    arrays = (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete, spaces.Dict)
    kept = [name for name, part in space.spaces.items() if isinstance(part, arrays)]
    if len(kept) == len(space.spaces):
        return env
    return gymnasium.wrappers.FilterObservation(env, kept)


def _make_id(name: str, keywords: dict[str, Any]) -> gymnasium.Env:
    missing = []
    for package in _PACKAGES:
        try:
            gymnasium.spec(name)
            break
        except gymnasium.error.Error:
            try:
                with contextlib.redirect_stderr(io.StringIO()):  # notes about other envs
                    gymnasium.register_envs(importlib.import_module(package))
            except Exception:
                missing.append(package)
    try:
        return gymnasium.make(name, disable_env_checker=True, **keywords)
    except gymnasium.error.UnregisteredEnv:
        near = difflib.get_close_matches(name, list(gymnasium.registry), n=3, cutoff=0.5)
        hint = f"Nearest: {', '.join(near)}." if near else "gymnasium.pprint_registry() lists all."
        if missing:
            hint += (
                f" Could not be imported here: {', '.join(missing)}. "
                "pip install 'torchrl_hmcts[gym]' adds mazes, MiniGrid and OGBench, "
                "'torchrl_hmcts[atari]' Atari."
            )
        raise ValueError(f"No env has the id {name!r}. {hint}") from None
    except gymnasium.error.DependencyNotInstalled as error:
        raise ImportError(
            f"{name} needs a package that is not installed: {' '.join(map(str, error.args))}. "
            "Those of Box2D, MuJoCo from version 4 of its robots on, MiniGrid and OGBench come "
            "with pip install 'torchrl_hmcts[gym]', Atari's with 'torchrl_hmcts[atari]'."
        ) from error


def _draws_globally(env: gymnasium.Env) -> bool:
    """Whether a reset or a few steps draw from a global generator."""
    before = _global_states()
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(3):
        if any(env.step(env.action_space.sample())[2:4]):
            env.reset(seed=0)
    after = _global_states()
    _set_global_states(before)
    return before != after


def _global_states() -> tuple[Any, Any]:
    """The states of NumPy's and Python's global generators, of which nothing can be changed."""
    return _as_bytes(np.random.get_state()), random.getstate()


def _as_bytes(state: Any) -> tuple[Any, ...]:
    kind, key, *rest = state
    return kind, key.tobytes(), *rest


def _set_global_states(states: tuple[Any, Any]) -> None:
    kind, key, *rest = states[0]
    np.random.set_state((kind, np.frombuffer(key, np.uint32), *rest))
    random.setstate(states[1])


class SettableGymEnv(GymWrapper):
    """A Gymnasium env that a planner can set to any state, exact to the bit.

    The entry ``"snapshot"``, uint8 ``[width]``, holds its state beside its observations. You can
    append any transform of TorchRL, an :class:`~torchrl_hmcts.transforms.OptionTransform` too.

    Args:
        env (str, gymnasium.Env or callable): an id, an env, or a function that makes one. It is
            reset.
        snapshot (type, tuple of two functions, or callable, optional): how to store its state, see
            :func:`~torchrl_hmcts.envs.gym.families.snapshot_of`. Default: chosen by the kind of
            env; the ``repr`` names it.
        cap (int): bytes of the attributes in a row at most. Default 65,536.
        features (callable, optional): ``features(env, observation)`` gives an array ``[F]``, the
            entry ``"features"``. Default: none.
        seed (int, optional): of the starts of its episodes. Default: drawn from torch's global
            generator.
        device (optional): of the tensors.
        **keywords: of ``gymnasium.make``.

    Raises:
        ValueError: if the id is unknown, or the state cannot be stored.
        ImportError: if a package is missing; the extra that has it is named.

    Example:
        >>> from torchrl_hmcts.envs import SettableGymEnv
        >>> env = SettableGymEnv("CartPole-v1", seed=0)
        >>> start = env.reset()
        >>> first = env.step(env.rand_action(start.clone()))["next", "observation"]
        >>> _ = env.reset(start, set_state=True)
        >>> env
        SettableGymEnv(CartPole-v1, snapshot=ClassicSnapshot, 80 bytes)

    Reference:
        Towers et al., "Gymnasium: A Standard Interface for Reinforcement Learning Environments",
        2024, arXiv 2407.17032.
    """

    _supports_set_state = True

    def __init__(
        self,
        env: str | gymnasium.Env | Callable[[], gymnasium.Env],
        *,
        snapshot: Any = None,
        cap: int = DEFAULT_CAP,
        features: Features | None = None,
        seed: int | None = None,
        device: Any = None,
        **keywords: Any,
    ) -> None:
        # TorchRL's metaclass adds a keyword of its own, which is no keyword of gymnasium.make.
        theirs = {
            name: keywords.pop(name) for name in list(keywords) if name.startswith("_torchrl")
        }
        made = make_gym(env, **keywords)
        stored = snapshot_of(made, snapshot, cap=cap)
        self.__dict__["_snapshot"], self.__dict__["_features"] = stored, features
        super().__init__(made, categorical_action_encoding=True, device=device, **theirs)
        row = Unbounded((stored.width,), dtype=torch.uint8, device=device)
        self.observation_spec[SNAPSHOT_KEY] = row
        self.state_spec = self.observation_spec.clone()
        if features is not None:
            first = _tensor(features(made, made.reset(seed=0)[0]))
            self.observation_spec[FEATURES_KEY] = Unbounded(
                first.shape, dtype=first.dtype, device=device
            )
        self._discrete = type(made.action_space) is spaces.Discrete and made.action_space.start == 0
        self._single = None if isinstance(made.observation_space, spaces.Dict) else "observation"
        self._generator = torch.Generator()
        seed = int(torch.randint(2**31, ())) if seed is None else seed
        self._set_seed(seed)

    @property
    def snapshot(self) -> Snapshot:
        """The snapshot that reads and restores the state."""
        stored: Snapshot = self.__dict__["_snapshot"]
        return stored

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._generator.manual_seed(whole_number("SettableGymEnv", "seed", seed))

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **kwargs: Any
    ) -> TensorDictBase:
        if set_state:
            return self._restored(tensordict)
        seed = int(torch.randint(2**31, (), generator=self._generator))
        self.snapshot.note_reset(seed)
        observation, _ = self._env.reset(seed=seed, **kwargs)
        return self._observed(observation, {})

    def _restored(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        keys = list(self.observation_spec.keys(True, True))
        given = tensordict is not None and [k for k in keys if tensordict.get(k, None) is None]
        if tensordict is None or given:
            raise SnapshotError(
                "reset(td, set_state=True) needs the entries that the env wrote: "
                f"{sorted(map(str, keys))}; missing: {given or 'all'}."
            )
        self.snapshot.restore(tensordict.get(SNAPSHOT_KEY).cpu().numpy())
        return tensordict.select(*keys)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Steps the env with a fifth of the bookkeeping of TorchRL's GymWrapper."""
        action = tensordict[self.action_key]
        if self._discrete:
            taken: Any = int(action)
        else:
            taken = self.read_action(action)
        self.snapshot.note_step(taken)
        observation, reward, terminated, truncated, _ = self._env.step(taken)
        entries: dict[Any, Any] = {}
        entries[self.reward_key] = torch.tensor([float(reward)])
        entries["terminated"] = torch.tensor([bool(terminated)])
        entries["truncated"] = torch.tensor([bool(truncated)])
        entries["done"] = torch.tensor([bool(terminated or truncated)])
        return self._observed(observation, entries)

    def _observed(self, observation: Any, entries: dict[Any, Any]) -> TensorDictBase:
        """Joins the entries of a step with those of the state that it led to."""
        entries |= _entries(observation, self._single)
        entries[SNAPSHOT_KEY] = torch.from_numpy(self.snapshot.read())
        if self._features is not None:
            entries[FEATURES_KEY] = _tensor(self._features(self._env, observation))
        td = TensorDict(entries, [])
        return td if self.device is None else td.to(self.device)

    def _picture(self) -> np.ndarray:
        """The state as the env draws it; a copy draws where the env itself does not.

        Raises:
            LookupError: if there is no picture, e.g. without a display that MuJoCo can draw on.
        """
        picture, env = None, self._env
        with contextlib.suppress(Exception):  # what a renderer raises is its own affair
            if env.render_mode != "rgb_array":
                env = gymnasium.make(env.spec, render_mode="rgb_array")
                snapshot_of(env, type(self.snapshot)).restore(self.snapshot.read())
            picture = env.render()
            if env is not self._env:
                env.close()
        if not isinstance(picture, np.ndarray):
            raise LookupError("the env draws no picture")
        return picture

    def _repr_html_(self) -> str:
        def draw(axes: Any) -> None:
            axes.imshow(self._picture())
            axes.axis("off")

        return notebook.shown(repr(self), draw)

    def __repr__(self) -> str:
        spec = self._env.spec
        name = spec.id if spec is not None else type(self._env.unwrapped).__name__
        kind = type(self.snapshot).__name__
        return f"{type(self).__name__}({name}, snapshot={kind}, {self.snapshot.width:,} bytes)"


def _entries(observation: Any, name: str | None) -> dict[str, Any]:
    """The arrays of an observation as tensors of their own, by name."""
    if name is None:
        return {
            key: _entries(value, None) if isinstance(value, dict) else _tensor(value)
            for key, value in observation.items()
        }
    return {name: _tensor(observation)}


def _tensor(value: Any) -> torch.Tensor:
    """A copy: some envs write each observation into the same array."""
    return torch.from_numpy(np.array(value))

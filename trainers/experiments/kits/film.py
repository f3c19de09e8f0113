"""A film of the options of a pool, base step by base step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from torchrl_hmcts.envs.gym.features import Features


class Film:
    """Keeps of each base step of a pool without processes the option, features ``[F]`` and picture.

    There are pictures only where they are asked for and the env draws any.
    """

    def __init__(self, features: Features, render: bool = False) -> None:
        self.features, self.render = features, render
        self.clear()

    def clear(self) -> None:
        """Forget all steps so far, e.g. those in which the pool tried its env out."""
        self.options: list[int] = []
        self.points: list[np.ndarray] = []
        self.frames: list[np.ndarray] = []

    def of(self, make: Callable[[], gymnasium.Env], worker: Any) -> tuple[Any, Any]:
        """Return what makes the env, and the worker, for a pool that is filmed."""
        return partial(_Filmed, make, self), _FilmedWorker(worker, self)


class _Filmed(gymnasium.Wrapper):
    is_stateless = True

    def __init__(self, make: Callable[[], gymnasium.Env], film: Film) -> None:
        super().__init__(make())
        self._film = film

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        outcome: Any = self.env.step(action)
        self._film.points.append(self._film.features(self.env, outcome[0]))
        if self._film.render and isinstance(picture := self.env.render(), np.ndarray):
            self._film.frames.append(picture)
        return outcome


class _FilmedWorker:
    def __init__(self, worker: Any, film: Film) -> None:
        self._worker, self._film = worker, film
        self.num_options = worker.num_options
        for name in {"begin", "ends"} & set(dir(worker)):
            setattr(self, name, getattr(worker, name))

    def act(self, observation: Any, option: int, generator: np.random.Generator) -> Any:
        self._film.options.append(option)
        return self._worker.act(observation, option, generator)

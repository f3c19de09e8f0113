"""State that the next update of a training depends on and that TorchRL's ``Trainer`` does not save.

Each class has ``state_dict`` and ``load_state_dict``, for any ``torchrl.checkpoint.Checkpoint``.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymLikeEnv, TransformedEnv
from torchrl.trainers import Trainer

from torchrl_hmcts.trainers.saving.checkpoints import PlainStateAdapter

Generator = torch.Generator | np.random.Generator | random.Random


class RunningEpisodes:
    """State of the episodes that a collector is in the middle of, which its state dict lacks.

    Where the env cannot be set to their states, loading begins new ones and says so on stderr,
    unless ``new_episodes`` is False.
    """

    new_episodes: bool | None = None

    def __init__(self, collector: Collector) -> None:
        self.collector = collector

    @property
    def complete(self) -> bool:
        """True if the env's whole state is in the tensordict."""
        env = self.collector.env
        return bool(env._supports_set_state or not env.batch_locked)

    def state_dict(self) -> dict[str, Any]:
        """Return the present episodes: their entries, and the collector's counts."""
        carrier = self.collector._carrier  # nothing public says where the episodes stand
        state: dict[str, Any] = {
            "batch_size": list(carrier.batch_size),
            "entries": carrier.to_dict(convert_tensors=False),
        }
        if self.collector.track_traj_ids:
            # The number of the next episode; put back once the collector has loaded, see below.
            state["traj_pool"] = self.collector.state_dict()["traj_pool"]
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Let the collector continue the episodes that :meth:`state_dict` returned."""
        env = getattr(self.collector.env, "base_env", self.collector.env)
        if self.new_episodes or (self.new_episodes is None and not self.complete):
            if self.new_episodes is None:
                words = "keeps state of its own, so the episodes that were under way are left out"
                hint = " A SettableGymEnv continues them." if isinstance(env, GymLikeEnv) else ""
                print(f"{type(env).__name__} {words}; new ones begin.{hint}", file=sys.stderr)
            return  # a collector that has not collected yet stands at the beginning of some
        if not self.complete:
            raise ValueError(
                f"{type(env).__name__} keeps state of its own, so its episodes "
                "cannot continue from a checkpoint. Use an env that can be set to any state, or "
                "load with new_episodes=True."
            )
        old = self.collector._carrier
        saved = torch.Size(state_dict["batch_size"])
        if saved != old.batch_size:
            raise ValueError(
                f"The checkpoint has episodes of an env of batch size {list(saved)}; this one has "
                f"{list(old.batch_size)}. Resume with the same number of copies."
            )
        if "traj_pool" in state_dict and self.collector.track_traj_ids:
            # Whenever a collector loads, it numbers an episode of each copy that it would begin.
            next_id = state_dict["traj_pool"]["traj_id"] - self.collector.n_env
            pool = {"traj_pool": {"traj_id": next_id}}
            self.collector.load_state_dict({**self.collector.state_dict(), **pool}, strict=False)
        carrier = TensorDict(dict(state_dict["entries"]), batch_size=saved, device=old.device)
        base = self.collector.env
        while isinstance(base, TransformedEnv):
            base = base.base_env
        if base.batch_locked:  # it steps from the state that it was set to
            with torch.random.fork_rng(devices=[]):
                state = carrier.select(*base.full_state_spec.keys(True, True))
                base.reset(state, set_state=True)
        self.collector._carrier = carrier


class GeneratorStates:
    """States of all random number generators below objects: in attributes, lists and dicts."""

    def __init__(self, **owners: Any) -> None:
        self.owners = owners
        self._known: dict[str, Generator] = {}
        self.generators()

    def generators(self) -> dict[str, Generator]:
        """Return the generators by their path, e.g. ``"env._generator"``, also of closed envs."""
        seen: set[int] = set()
        for name, owner in self.owners.items():
            self._known.update(_find(name, owner, seen, True))
        return dict(self._known)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of every generator, by the path to it."""
        states: dict[str, Any] = {}
        for path, generator in self.generators().items():
            if isinstance(generator, torch.Generator):
                states[path] = generator.get_state()
            elif isinstance(generator, np.random.Generator):
                states[path] = generator.bit_generator.state
            else:
                states[path] = generator.getstate()
        return states

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Set the generators to the states that :meth:`state_dict` returned."""
        generators = self.generators()
        missing = sorted(set(state_dict).difference(generators))
        if missing:
            raise ValueError(
                f"The checkpoint has states of the generators {missing}; found here: "
                f"{sorted(generators)}. Build env, transforms and policy as in the saved run."
            )
        for path, state in state_dict.items():
            generator = generators[path]
            if isinstance(generator, torch.Generator):
                generator.set_state(state)
            elif isinstance(generator, np.random.Generator):
                generator.bit_generator.state = state
            else:
                generator.setstate(state)


def _find(
    path: str, value: Any, seen: set[int], owner: bool = False
) -> Iterator[tuple[str, Generator]]:
    """Yields the generators below a value with their paths."""
    if id(value) in seen:
        return
    if isinstance(value, torch.Generator | np.random.Generator | random.Random):
        seen.add(id(value))
        yield path, value
        return
    items: Iterable[tuple[Any, Any]] = ()
    if isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, list | tuple):
        items = list(enumerate(value))
    elif isinstance(value, nn.Module) or (owner and hasattr(value, "__dict__")):
        items = list(vars(value).items())
    if items:
        seen.add(id(value))
        for name, item in items:
            yield from _find(f"{path}.{name}", item, seen)


class HistoryState:
    """The curves that a ``Trainer`` has logged so far, as part of its checkpoint."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer

    def state_dict(self) -> dict[str, torch.Tensor]:
        log = self.trainer._log_dict  # the only place in which TorchRL keeps its curves
        return {
            key: torch.tensor([float(value) for value in values], dtype=torch.float64)
            for key, values in log.items()
        }

    def load_state_dict(self, state_dict: Mapping[str, torch.Tensor]) -> None:
        self.trainer._log_dict.clear()
        for key, values in state_dict.items():
            self.trainer._log_dict[key] = values.tolist()


class BufferAdapter(PlainStateAdapter):
    """Writes a replay buffer; rows without an entry are zeros, not what the memory held before."""

    def save(self, component: Any, path: Path, **options: Any) -> Any:
        storage = component.storage
        rows = getattr(storage, "_storage", None)  # behind the filled part, which storage[:] is
        if isinstance(rows, torch.Tensor | TensorDictBase) and storage.ndim == 1:
            rows[len(storage) :].zero_()
        return super().save(component, path, **options)

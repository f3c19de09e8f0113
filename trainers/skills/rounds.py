"""Rounds of planning and acting, as something a TorchRL ``Trainer`` can collect from.

Letters: m rounds side by side, n base transitions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import TransformedEnv

from torchrl_hmcts.planners import MCTSPlanner
from torchrl_hmcts.trainers.collectors import LocalCollector
from torchrl_hmcts.trainers.evaluation import Results, execute_plans, plan_and_execute

RECORDED = ("round", "training_steps", "solved", "found", "simulated_steps", "executed_steps")


class RoundRecords:
    """Costs of each round of planning and acting, in the order in which they were played."""

    def __init__(self, columns: Mapping[str, np.ndarray] | None = None) -> None:
        self.columns = {
            name: np.asarray([] if columns is None else columns[name], dtype=np.int64)
            for name in RECORDED
        }

    def __len__(self) -> int:
        return len(self.columns["round"])

    def add(self, results: Results, rounds: np.ndarray, training_steps: int) -> dict[str, float]:
        """Append rounds; return their means."""
        new = RoundRecords(
            {
                "round": rounds,
                "training_steps": np.full(len(rounds), training_steps),
                "solved": results.solved,
                "found": results.found,
                "simulated_steps": results.simulated_steps,
                "executed_steps": results.episode_steps,
            }
        )
        for name, values in new.columns.items():
            self.columns[name] = np.concatenate((self.columns[name], values))
        means = new.curve()
        names = ("solved", "base_steps", "simulated_steps", "executed_steps")
        return {name: float(means[name][0]) for name in names}

    def curve(self) -> dict[str, np.ndarray]:
        """Return means over the rounds played at the same training, float64 ``[points]``.

        Entries ``training_steps``, ``rounds`` (how many), ``solved`` (share), ``base_steps`` to
        solve (simulated and executed; a round that was not solved counts with what it cost),
        ``simulated_steps`` and ``executed_steps``.
        """
        steps, index = np.unique(self.columns["training_steps"], return_inverse=True)
        count = np.bincount(index, minlength=len(steps)).astype(float)

        def mean(values: np.ndarray) -> np.ndarray:
            return np.bincount(index, weights=values, minlength=len(steps)) / count

        simulated, executed = self.columns["simulated_steps"], self.columns["executed_steps"]
        return {
            "training_steps": steps.astype(float),
            "rounds": count,
            "solved": mean(self.columns["solved"]),
            "base_steps": mean(simulated + executed),
            "simulated_steps": mean(simulated),
            "executed_steps": mean(executed),
        }

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {name: torch.from_numpy(values.copy()) for name, values in self.columns.items()}

    def load_state_dict(self, state_dict: Mapping[str, torch.Tensor]) -> None:
        self.columns = {name: state_dict[name].numpy().copy() for name in RECORDED}


class PlanningRounds(LocalCollector):
    """Plays the rounds of Algorithm 3 and yields the base transitions they consisted of.

    The first batch are those of ``num_init_samples`` options, each drawn uniformly and executed
    from a state after a reset. Every later batch is ``interval`` rounds: a plan is searched from a
    state after a reset and executed; both the simulated and the executed base transitions count.

    Random numbers are a function of ``seed`` and of the round, so that a resumed run needs to know
    no more than its round.
    """

    def __init__(
        self,
        env: TransformedEnv,
        simulator: TransformedEnv,
        make_planner: Callable[..., MCTSPlanner],
        *,
        num_init_samples: int,
        interval: int,
        rounds: int,
        seed: int,
    ) -> None:
        self.env, self.simulator = env, simulator
        self.make_planner = make_planner
        self.recorders = [made.transform[-1] for made in (env, simulator)]
        self.num_init_samples, self.interval = num_init_samples, interval
        self.rounds, self.seed = rounds, seed
        self.round = -1  # the next one; -1: the first samples have not been drawn
        self.training_steps = 0  # base steps handed out so far
        self.init_steps = 0  # those of the first samples
        self.records = RoundRecords()
        self.latest: dict[str, float] = {}  # means of the latest batch of rounds

    def __iter__(self) -> Iterator[TensorDictBase]:
        while self.round < self.rounds:
            if self.round < 0:
                with seeded(self.seed, "init", 0) as seed:
                    self._draw(seed)
                self.round = 0
            else:
                count = min(self.interval - self.round % self.interval, self.rounds - self.round)
                with seeded(self.seed, "round", self.round) as seed:
                    self._play(count, seed)
                self.round += count
            taken = [data for recorder in self.recorders if len(data := recorder.take())]
            batch = torch.cat(taken) if len(taken) > 1 else taken[0]
            self.training_steps += len(batch)
            yield batch

    def _starts(self, count: int, seed: int) -> TensorDictBase:
        self.env.set_seed(seed)
        return self.env.reset(TensorDict(batch_size=[count], device=self.env.device))

    def _draw(self, seed: int) -> None:
        starts = self._starts(self.num_init_samples, seed)
        num_options = int(self.env.full_action_spec[self.env.action_keys[0]].space.n)
        options = torch.randint(num_options, (self.num_init_samples,))
        self.init_steps = int(execute_plans(self.env, starts, options[:, None]).base_steps.sum())

    def _play(self, count: int, seed: int) -> None:
        planner = self.make_planner(self.simulator, seed=seed)
        starts = self._starts(count, seed)
        results = plan_and_execute(planner, self.env, starts, group=count)
        rounds = self.round + np.arange(count)
        self.latest = self.records.add(results, rounds, self.training_steps)

    def state_dict(self) -> dict[str, Any]:
        names = ("round", "training_steps", "init_steps", "seed", "interval")
        counters = {name: getattr(self, name) for name in names}
        return {**counters, "records": self.records.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        for name, argument in (("interval", "retrain_interval"), ("seed", "seed")):
            if int(state_dict[name]) != getattr(self, name):
                raise ValueError(
                    f"The checkpoint was written with {argument}={int(state_dict[name])}; this "
                    f"trainer has {getattr(self, name)}. Resume with the same one."
                )
        for name in ("round", "training_steps", "init_steps"):
            setattr(self, name, int(state_dict[name]))
        self.records.load_state_dict(state_dict["records"])


@contextmanager
def seeded(seed: int, phase: str, index: int) -> Iterator[int]:
    """Make torch's global generator a function of the arguments, and leave it as it was."""
    entropy = [seed, *phase.encode(), index]
    own, other = np.random.SeedSequence(entropy).generate_state(2, np.uint32).tolist()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(own)
        yield other >> 1


def frames_curve(
    records: RoundRecords, frames_per_step: int, max_frames: int
) -> dict[str, list[float]]:
    """Return the mean frames of an episode against the frames of training; Figure 4.10's curve.

    An episode without a plan, or whose plan fails, counts with its whole length.
    """
    columns = records.columns
    out: dict[str, list[float]] = {}
    for steps in np.unique(columns["training_steps"]):
        here = columns["training_steps"] == steps
        solved = columns["solved"][here].astype(bool)
        frames = columns["executed_steps"][here] * frames_per_step
        point = {
            "training_steps": float(steps * frames_per_step),
            "frames": float(np.where(solved, frames, max_frames).mean()),
            "solved": float(solved.mean()),
            "solved_frames": float(frames[solved].mean()) if solved.any() else float("nan"),
        }
        for name, value in point.items():
            out.setdefault(name, []).append(value)
    return out

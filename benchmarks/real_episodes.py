"""Acting where no state can be set: episodes in a Waterworld that only resets and steps.

Letters: M mazes and episodes, H rows, W columns.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from torchrl_hmcts.envs import WaterworldMazeEnv
from torchrl_hmcts.modules import OptionMemory
from torchrl_hmcts.trainers.evaluation import spread
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_starts


class EpisodesInEachMaze(WaterworldMazeEnv):
    """A Waterworld as a robot meets it: its state is inside, and it cannot be set.

    ``reset()`` starts one episode in each of the first mazes, at places drawn from the seed (those
    of ``make_starts``). A tensordict tells it the action, and
    nothing else; a planner refuses it as a simulator.

    Args:
        mazes: bool ``[M, H, W]``.
        num_mazes: how many of them are played, the batch size.
        max_steps: base steps after which an episode is truncated. Default 1,000.
        seed: of the places.

    Example:
        >>> from torchrl_hmcts.envs import maze_pool
        >>> env = EpisodesInEachMaze(maze_pool("test"), 3, seed=0)
        >>> env.reset()["maze_index"].tolist(), env.batch_locked
        ([0, 1, 2], True)
    """

    batch_locked = True
    _supports_set_state = False

    def __init__(
        self, mazes: Tensor, num_mazes: int, *, max_steps: int = 1000, seed: int = 0
    ) -> None:
        super().__init__(mazes, max_steps=max_steps, batch_size=[num_mazes], seed=seed)
        self.starts_seed = seed
        self.state_spec = Composite(shape=self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        starts = make_starts(self, self.batch_size[0], self.starts_seed)
        self._now = starts.exclude(*self.done_keys)
        return self._now.copy()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = super()._step(self._now.copy().set("action", tensordict.get("action")))
        steps = tensordict.get("_step", None)
        now = after.select(*self._now.keys())
        if steps is not None:
            now = torch.where(steps.reshape(self.batch_size), now, self._now)
        self._now = now
        return after.update(now)


@dataclass
class Episodes:
    """What acting in the real env gave, one entry per maze ``[M]``.

    ``solved`` (bool); ``base_steps`` executed and ``num_plans`` made (int64); ``seconds`` of all
    episodes together.
    """

    solved: Tensor
    base_steps: Tensor
    num_plans: Tensor
    seconds: float

    def summary(self) -> dict[str, Any]:
        """Return counts, and mean, median and 95th percentile of the solved episodes' steps."""
        return {
            "mazes": len(self.solved),
            "solved": int(self.solved.sum()),
            "share_solved": round(float(self.solved.float().mean()), 4),
            "episode_steps": spread(self.base_steps[self.solved].numpy()),
            "num_plans": spread(self.num_plans[self.solved].numpy()),
            "seconds": round(self.seconds, 1),
        }


def act(
    policy: TensorDictModuleBase,
    real: EnvBase,
    *,
    max_options: int,
    memory: OptionMemory | None = None,
) -> Episodes:
    """Let a policy act in an env of many episodes by ``env.reset()`` and ``env.step()`` only.

    Args:
        policy: writes options, e.g. a :class:`~torchrl_hmcts.planners.HierarchicalPolicy`.
        real: the macro environment, batch ``[M]``.
        max_options: options after which an episode is given up.
        memory: told what the options led to.
    """
    begin = time.perf_counter()
    td = real.reset()
    going = torch.ones(real.batch_size, dtype=torch.bool)
    solved, steps = torch.zeros_like(going), torch.zeros(real.batch_size, dtype=torch.int64)
    with torch.no_grad():
        for _ in range(max_options):
            td = real.step(policy(td.set("_step", going.clone())))
            after = td["next"]
            if memory is not None:
                memory.remember(td[going])
            steps += after["duration"][:, 0] * going
            solved |= after["terminated"][:, 0] & going
            going = going & ~after["done"][:, 0]
            if not going.any():
                break
            td = step_mdp(td)
    plans = td["num_plans"][:, 0]
    return Episodes(solved, steps, plans, time.perf_counter() - begin)

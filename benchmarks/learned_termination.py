"""Learning when Waterworld's options should end: the option-critic, with targets in hindsight.

Letters: C copies, T base steps of each, *B batch of the tensordict, b batch of an update.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.modules import MLP
from torchrl.objectives import LossModule, SoftUpdate

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.modules import TerminationNetwork
from torchrl_hmcts.objectives import IntraOptionQLoss, OptionTerminationLoss
from torchrl_hmcts.transforms import SkillTransform

_EPISODE_STEPS = 200  # base steps in a maze before the next one


class MazeView(TensorDictModuleBase):
    """Writes what lies around the disc, ``"view"`` float32 ``[*B, F]``.

    Reads ``"position"``, ``"velocity"`` and ``"maze_index"``. The features are the position within
    the tile (2, from -1 to 1), the velocity (2) and the walls of the surrounding
    ``(2 reach + 1) ** 2`` tiles (1 is solid, as is all outside).

    Args:
        mazes: bool ``[M, H, W]`` of the env that is viewed.
        reach: tiles seen in each direction. Default 2.
    """

    _solid: Tensor
    _offsets: Tensor

    def __init__(self, mazes: Tensor, *, reach: int = 2) -> None:
        super().__init__()
        self.in_keys: list[NestedKey] = ["position", "velocity", "maze_index"]
        self.out_keys: list[NestedKey] = ["view"]
        solid = torch.nn.functional.pad(mazes, (reach,) * 4, value=True)  # [M, H', W']
        span = torch.arange(2 * reach + 1)
        self.num_features = 4 + len(span) ** 2
        self._shape = solid.shape
        self.register_buffer("_solid", solid.to(torch.float32).flatten(), persistent=False)
        offsets = (span[:, None] * solid.shape[2] + span).flatten()
        self.register_buffer("_offsets", offsets, persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the view of each row."""
        position = tensordict.get("position")
        tile = position.long()
        _, height, width = self._shape
        corner = (tensordict.get("maze_index") * height + tile[..., 1]) * width + tile[..., 0]
        walls = self._solid[corner.unsqueeze(-1) + self._offsets]
        within = 2.0 * (position - tile) - 1.0
        return tensordict.set("view", torch.cat((within, tensordict.get("velocity"), walls), -1))


class HindsightTransitions:
    r"""Pieces of options from stored base steps, with targets that may have been reached.

    A piece is ``every`` base steps of one option. Half of the targets are places that the same
    episode reached later, the others places it visited at any time. The reward of a piece is
    :math:`\gamma^i` if its base step ``i`` touches the target, which also terminates it.

    Args:
        data: base transitions ``[C, T]`` with ``"skill"`` and ``"skill_step"``.
        view: writes what networks see of a state.
        touch: distance from the target, tiles, at which it is reached.
        every: base steps of a piece.
        horizon: base steps within which a place that was reached serves as a target.
        gamma: discount per base step.
        seed: of the draws.

    Raises:
        ValueError: if the data hold no whole piece.
    """

    def __init__(
        self,
        data: TensorDictBase,
        view: MazeView,
        *,
        touch: float,
        every: int = 5,
        horizon: int = 100,
        gamma: float = 0.98,
        seed: int = 0,
    ) -> None:
        copies, length = data.batch_size
        done = data["next", "done"].squeeze(-1)
        # Places before each step, and the one after the last.
        self.position = torch.cat((data["position"], data["next", "position"][:, -1:]), 1)
        self.after = data["next", "position"]  # [C, T, 2]
        self.view = view(data.copy())["view"]  # [C, T, F]
        self.view_after = view(data["next"].copy())["view"]
        self.skill = data["skill"]  # [C, T]
        self.skill_step = data["skill_step"].squeeze(-1)  # [C, T]
        time = torch.arange(length)
        # First and last base step of the episode that each base step belongs to.
        begins = torch.cat((torch.ones(copies, 1, dtype=torch.bool), done[:, :-1]), 1)
        self.first = torch.where(begins, time, 0).cummax(1).values
        ends = torch.where(done, time, length - 1)
        self.last = ends.flip(1).cummin(1).values.flip(1)
        # Where a piece begins: its last base step is of the same option and episode.
        begin, end = slice(0, max(0, length - every + 1)), slice(every - 1, None)
        same = self.skill_step[:, end] == self.skill_step[:, begin] + every - 1
        same &= self.first[:, end] == self.first[:, begin]
        self.pieces = same.nonzero()  # [P, 2] of copy and base step
        if not len(self.pieces):
            raise ValueError(
                f"The data hold no piece of an option of every={every} base steps; they are "
                f"{length} base steps of {copies} copies. Collect more, or make it shorter."
            )
        self.every, self.horizon, self.gamma, self.touch = every, horizon, gamma, touch
        self.generator = torch.Generator().manual_seed(seed)

    def sample(self, batch_size: int) -> TensorDict:
        """Return at most ``batch_size`` transitions ``[b]``, none of which begins at its target.

        ``"begin"`` holds what an earlier step of the same option saw, where it may have begun.
        """

        def draw(low: Tensor, high: Tensor) -> Tensor:  # both included
            share = torch.rand(low.shape, generator=self.generator)
            return low + ((high - low + 1) * share).long()

        index = torch.randint(len(self.pieces), (batch_size,), generator=self.generator)
        copy, step = self.pieces[index].unbind(-1)
        first, last = self.first[copy, step], self.last[copy, step]
        later = draw(step, (step + self.horizon).clamp_max(last))
        chosen = torch.where(
            torch.rand(batch_size, generator=self.generator) < 0.5, later, draw(first, last)
        )
        target = self.after[copy, chosen]  # [b, 2]
        begun = draw((step - self.skill_step[copy, step]).clamp_min(first), step)
        span = step.unsqueeze(-1) + torch.arange(self.every)
        path = self.after[copy.unsqueeze(-1), span]  # [b, every, 2]
        hit = (path - target.unsqueeze(1)).norm(dim=-1) < self.touch
        reached = hit.any(-1)
        when = hit.to(torch.int64).argmax(-1)
        reward = torch.where(reached, self.gamma**when, 0.0)
        there = (self.position[copy, step] - target).norm(dim=-1) < self.touch
        end = step + self.every - 1

        def seen(view: Tensor, place: Tensor, **entries: Any) -> TensorDict:
            td = {"view": view, "offset": target - place, **entries}
            return TensorDict(td, batch_size=[batch_size])

        after = seen(
            self.view_after[copy, end],
            self.after[copy, end],
            reward=reward.unsqueeze(-1),
            terminated=reached.unsqueeze(-1),
            duration=torch.full((batch_size, 1), self.every),
        )
        out = seen(
            self.view[copy, step],
            self.position[copy, step],
            skill=self.skill[copy, step],
            begin=seen(self.view[copy, begun], self.position[copy, begun]),
            next=after,
        )
        return out[~there]


@dataclass
class TerminationConfig:
    """How a termination is learned."""

    base_steps: int = 20_000  # of options executed in training mazes: all the experience there is
    copies: int = 32  # mazes played at once
    option_steps: int = 50  # base steps of an option in that experience
    every: int = 5  # base steps between two chances to end; those that a transition spans
    horizon: int = 100  # base steps within which a place that was reached serves as a target
    gamma: float = 0.98  # discount per base step; shorter-sighted than the manager, less noisy
    initial_probability: float = 0.05  # to end, each time, of options whose values come first
    rounds: int = 1  # values under the termination, then the termination from the values
    value_updates: int = 5_000  # in a round
    termination_updates: int = 500  # in a round
    batch_size: int = 256  # transitions of an update
    deliberation_cost: float = 0.04  # of ending an option; a target at once is worth 1
    value_lr: float = 1e-3
    termination_lr: float = 1e-3
    tau: float = 0.01  # share by which the target values follow in an update
    seed: int = 0  # of mazes, networks and batches


def collect_option_steps(
    worker: Callable[[TensorDictBase], TensorDictBase], num_options: int, config: TerminationConfig
) -> TensorDictBase:
    """Let the worker execute random options in random training mazes.

    Returns:
        Base transitions ``[C, T]`` with the option under ``"skill"`` and the base steps it has
        taken before under ``"skill_step"``.
    """
    env = TransformedEnv(
        WaterworldMazeEnv(
            observation=False,
            batch_size=[config.copies],
            max_steps=_EPISODE_STEPS,
            seed=config.seed,
        ),
        SkillTransform(num_options, max_skill_steps=config.option_steps, seed=config.seed),
    )
    steps = config.base_steps // config.copies
    return env.rollout(steps, worker, break_when_any_done=False)


def learn_termination(
    worker: Callable[[TensorDictBase], TensorDictBase],
    num_options: int,
    config: TerminationConfig,
    *,
    data: TensorDictBase | None = None,
) -> tuple[TerminationNetwork, dict[str, list[float]]]:
    """Learn when options should end, from random options and targets in hindsight.

    Values Q(s, o, target) are learned for options that end with the probability of the termination
    as it is, from pieces of options (:class:`~torchrl_hmcts.objectives.IntraOptionQLoss`), for
    targets that were reached. The termination, which does not see the target, is then learned from
    states met under an option that was the best for its target where it began
    (:class:`~torchrl_hmcts.objectives.OptionTerminationLoss`): it ends options where, over all
    targets, continuing loses more than the deliberation cost, as at the mouth of a side passage.

    Args:
        worker: reads ``"velocity"`` and ``"skill"``, writes ``"action"``.
        num_options: number of options.
        config: numbers of base steps, updates, ...
        data: of :func:`collect_option_steps`. Default: collected here.

    Returns:
        The network, which reads ``"view"`` of a :class:`MazeView` and ``"skill"``; and losses and
        diagnostics by name, every 100 updates.

    Reference:
        Bacon, Harb and Precup, "The option-critic architecture", 2017, arXiv 1609.05140; Harb et
        al., "When waiting is not an option", 2018, arXiv 1709.04571; Andrychowicz et al.,
        "Hindsight experience replay", 2017, arXiv 1707.01495.
    """
    if data is None:
        data = collect_option_steps(worker, num_options, config)
    view = MazeView(maze_pool("train"))
    transitions = HindsightTransitions(
        data,
        view,
        touch=WaterworldMazeEnv.PLAYER_RADIUS + WaterworldMazeEnv.TARGET_RADIUS,
        every=config.every,
        horizon=config.horizon,
        gamma=config.gamma,
        seed=config.seed,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = TerminationNetwork(
            view.num_features,
            num_options,
            in_keys=["view"],
            initial_probability=config.initial_probability,
        )
        values = TensorDictModule(
            MLP(
                in_features=view.num_features + 2,
                out_features=num_options,
                num_cells=[128, 128],
                activation_class=torch.nn.ReLU,
            ),
            in_keys=["view", "offset"],  # the offset: target minus position
            out_keys=["action_value"],
        )
    value_loss = IntraOptionQLoss(values, network, gamma=config.gamma)
    updater = SoftUpdate(value_loss, tau=config.tau)
    loss = OptionTerminationLoss(network, values, deliberation_cost=config.deliberation_cost)
    # The losses hold the parameters: those of the networks are the same tensors.
    value_optimizer = torch.optim.Adam(value_loss.parameters(), lr=config.value_lr, fused=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=config.termination_lr, fused=True)
    history: dict[str, list[float]] = {}

    def step(
        part: LossModule, adam: torch.optim.Optimizer, name: str, batch: TensorDictBase, update: int
    ) -> None:
        out = part(batch)
        adam.zero_grad()
        out[name].backward()
        adam.step()
        if update % 100 == 99:
            for key, value in out.detach().items():
                history.setdefault(key, []).append(float(value))

    for _ in range(config.rounds):
        for update in range(config.value_updates):
            batch = transitions.sample(config.batch_size)
            step(value_loss, value_optimizer, "loss_qvalue", batch, update)
            updater.step()
        for update in range(config.termination_updates):
            batch = transitions.sample(config.batch_size)
            with torch.no_grad():
                best = values(batch["begin"])["action_value"].argmax(-1)
            batch = batch[best == batch["skill"]]  # on-policy: options that would be chosen
            if len(batch):
                step(loss, optimizer, "loss_termination", batch, update)
    return network, history

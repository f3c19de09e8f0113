"""A model of options in Waterworld, learned from ordinary episodes, and planning in it.

The agent here never sets a real env to a state: it resets and steps.

Letters: *B batch of the tensordict, N transitions, M mazes, H rows, W columns, K walls of a maze, T
base steps an option takes at most, R tiles that a window reaches to each side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from operator import index
from typing import Any

import torch
from maze_window import MazeWindow
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_pool
from torchrl_hmcts.modules import OptionModel, OptionModelEnv
from torchrl_hmcts.objectives import OptionModelLoss
from torchrl_hmcts.transforms import OptionTransform

_ROOT_KEYS = ["observation", "position", "velocity", "target", "option", "maze_index", "step_count"]
_TOUCH = WaterworldMazeEnv.PLAYER_RADIUS + WaterworldMazeEnv.TARGET_RADIUS


@dataclasses.dataclass
class OptionModelConfig:
    """How a model of Waterworld's options is learned.

    Args:
        base_steps: recorded in the training mazes, by options drawn at random.
        option_steps: base steps of an option.
        num_options: options, the worker's skills.
        gamma: discount per base step.
        copies: mazes played at once.
        episode_steps: base steps after which a copy gets a new maze; a multiple of
            ``option_steps``, so that no option is cut short.
        hindsight: further targets per transition, at which its path is looked at again.
        num_models: members of the ensemble.
        hidden: widths of the networks' layers.
        updates: gradient steps.
        batch_size: transitions of a gradient step.
        lr: learning rate at the start; it falls to 0 on half a cosine.
        weight_decay: of AdamW.
        bootstrap: each member learns from its own random half of the transitions.
        delta_coeff: weight of the change of the state, beside reward, duration and end.
        seed: of recording and learning.
    """

    base_steps: int = 100_000
    option_steps: int = 25
    num_options: int = 4
    gamma: float = 0.99
    copies: int = 100
    episode_steps: int = 400
    hindsight: int = 3
    num_models: int = 5
    hidden: tuple[int, ...] = (128, 128, 128)
    updates: int = 4_000
    batch_size: int = 256
    lr: float = 2e-3
    weight_decay: float = 1e-4
    bootstrap: bool = False
    delta_coeff: float = 5.0
    seed: int = 0


class _RefreshObservation(TensorDictModuleBase):
    """Writes the player's place into the observation, whose walls and target stay."""

    in_keys = ["observation", "position"]
    out_keys = ["observation"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict.get("observation").clone()
        observation[..., :2] = tensordict.get("position")
        return tensordict.set("observation", observation)


def record_transitions(worker: Any, config: OptionModelConfig) -> tuple[TensorDict, int]:
    """Record options drawn at random in the training mazes, in ordinary episodes."""
    torch.manual_seed(config.seed)
    env = TransformedEnv(
        WaterworldMazeEnv(
            maze_pool("train"),
            max_steps=config.episode_steps,
            batch_size=[config.copies],
            seed=config.seed,
        ),
        OptionTransform(
            worker,
            config.num_options,
            config.option_steps,
            config.gamma,
            trajectory_keys=[("next", "position"), ("next", "velocity")],
        ),
    )
    per_batch = max(1, config.base_steps // (config.copies * config.option_steps))
    frames = per_batch * config.copies
    collector = Collector(env, None, frames_per_batch=frames, total_frames=frames)
    data = next(iter(collector)).reshape(-1)
    collector.shutdown()
    return data.select(*_ROOT_KEYS, "next"), int(data["next", "duration"].sum())


def relabel_targets(data: TensorDictBase, *, gamma: float, seed: int) -> TensorDict:
    """Ask of each recorded path what would have happened with another target near by.

    The target has no influence on the disc until they touch, so the path answers: either it never
    comes near the new target, and the transition stays as it was, or the option ends there.

    Reference:
        Andrychowicz et al., "Hindsight Experience Replay", 2017, arXiv 1707.01495.
    """
    after, _start = data["next"], data["position"]
    path, there = after["trajectory", "next", "position"], after["trajectory", "mask"]
    target, usable = _draw_targets(data, torch.Generator().manual_seed(index(seed)))
    touches = ((path - target.unsqueeze(1)).norm(dim=-1) < _TOUCH) & there  # [N, T]
    hit = (touches.any(-1) & usable).unsqueeze(-1)
    first = touches.to(torch.int8).argmax(-1)
    row = torch.arange(len(first))
    out = data.exclude(("next", "trajectory")).clone()
    new = torch.where(usable.unsqueeze(-1), target, data["target"])
    for part in (out, out["next"]):
        part["target"] = new
        part["observation"][:, 2:4] = new
    for key in ("position", "velocity"):
        reached = after["trajectory", "next", key][row, first]
        out["next", key] = torch.where(hit, reached, after[key])
    out["next", "observation"][:, :2] = out["next", "position"]
    out["next", "duration"] = torch.where(hit, first.unsqueeze(-1) + 1, after["duration"])
    reward = gamma ** first.unsqueeze(-1).to(torch.float32)
    out["next", "reward"] = torch.where(hit, reward, after["reward"])
    out["next", "terminated"] = hit | after["terminated"]
    return out


def _draw_targets(
    data: TensorDictBase, generator: torch.Generator, tries: int = 8
) -> tuple[Tensor, Tensor]:
    """Centres of free tiles ``[N, 2]``, and whether one was found in so many tries ``[N]``."""
    after = data["next"]
    path, there = after["trajectory", "next", "position"], after["trajectory", "mask"]
    start, walls = data["position"], data["observation"][:, 4:].unflatten(-1, (-1, 2))
    shape, row = (len(data), tries), torch.arange(len(data)).unsqueeze(-1)
    # Half of them around the player, half around a place on its way, where a touch is likely.
    moment = (torch.rand(shape, generator=generator) * there.sum(-1, keepdim=True)).long()
    far = start.floor().unsqueeze(1) + torch.randint(-3, 4, (*shape, 2), generator=generator)
    near = path[row, moment].floor() + torch.randint(-1, 2, (*shape, 2), generator=generator)
    on_way = torch.rand((len(data), 1, 1), generator=generator) < 0.5
    target = torch.where(on_way, near, far) + 0.5
    usable = ((target > 0.0) & (target < 9.0)).all(-1)
    usable &= (walls.unsqueeze(1) != target.unsqueeze(2)).any(-1).all(-1)
    usable &= (start.unsqueeze(1) - target).norm(dim=-1) >= _TOUCH
    usable &= ~after["terminated"]
    chosen = usable.to(torch.int8).argmax(-1)
    return target[row[:, 0], chosen], usable.any(-1)


def make_option_model(config: OptionModelConfig) -> OptionModel:
    """Build an untrained model of Waterworld's options."""
    window = MazeWindow(config.num_options)

    def make_network(out_features: int) -> nn.Module:
        layers: list[nn.Module] = []
        widths = (window.num_features, *config.hidden)
        for fan_in, fan_out in zip(widths, config.hidden, strict=False):
            linear = nn.Linear(fan_in, fan_out)
            nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
            layers += [linear, nn.SiLU()]
        return nn.Sequential(*layers, nn.Linear(widths[-1], out_features))

    return OptionModel(
        make_network,
        ["features"],
        {"position": 2, "velocity": 2},
        max_duration=config.option_steps,
        num_models=config.num_models,
        features=window,
    )


def train_option_model(
    data: TensorDictBase,
    config: OptionModelConfig,
    *,
    progress: Callable[[int, TensorDictBase], None] | None = None,
) -> OptionModel:
    """Learn a model from recorded transitions."""
    parts = [data.exclude(("next", "trajectory"))]
    for i in range(config.hindsight):
        parts.append(relabel_targets(data, gamma=config.gamma, seed=1_000 * config.seed + i))
    examples: TensorDictBase = torch.cat(parts)
    torch.manual_seed(config.seed)
    model = make_option_model(config).fit_normalization(examples)
    if config.bootstrap:
        shape = (len(examples), config.num_models)
        examples["bootstrap_mask"] = 2.0 * torch.randint(2, shape)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(examples)), batch_size=config.batch_size
    )
    buffer.extend(examples)
    loss = OptionModelLoss(model, delta_coeff=config.delta_coeff)
    optimizer = torch.optim.AdamW(loss.parameters(), lr=config.lr, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.updates)
    for update in range(config.updates):
        losses = loss(buffer.sample())
        total = sum(value for key, value in losses.items() if key.startswith("loss"))
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        schedule.step()
        if progress is not None:
            progress(update, losses.detach())
    return model.eval()


def make_model_env(model: OptionModel, real: Any, **options: Any) -> OptionModelEnv:
    """Build the macro env to plan in for a model of Waterworld's options."""
    return OptionModelEnv(
        model,
        real,
        counter_keys=["step_count"],
        readout=_RefreshObservation(),
        **{"min_reward": 0.5, **options},
    )


def error_by_horizon(model_env: EnvBase, real: EnvBase, horizon: int) -> list[float]:
    """Return how far the model is from the real env after 1 to ``horizon`` random options."""
    with torch.no_grad():
        td = real.rollout(horizon, break_when_any_done=False, break_when_all_done=True)
    state, going = td[:, 0].exclude("next"), torch.ones(len(td), dtype=torch.bool)
    errors = []
    for i in range(td.shape[1]):
        after = td["next"][:, i]
        going = going & ~after["done"][:, 0]
        state = model_env.step(state.set("option", td["option"][:, i]))["next"]
        distance = (state["position"] - after["position"]).norm(dim=-1)[going]
        errors.append(round(float(distance.median()), 4))
    return errors

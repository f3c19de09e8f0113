"""How well a worker's skills can be told apart, and how far a search gets with them.

Letters: M mazes, Z skills, E = M * Z mini-episodes, T base steps.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_hmcts.envs import WaterworldMazeEnv, free_tiles, shortest_path_lengths
from torchrl_hmcts.planners import Search


@torch.no_grad()
def skill_figures(
    policy: TensorDictModuleBase,
    discriminator: TensorDictModuleBase,
    mazes: Tensor,
    *,
    num_skills: int = 4,
    steps: tuple[int, ...] = (25, 50, 100),
    seed: int = 0,
) -> dict[int, dict[str, Any]]:
    """Let every skill act once in every maze, and ask the discriminator which it was.

    Each mini-episode starts at rest in the middle of a free tile drawn uniformly; the displacement
    is measured from there.

    Args:
        policy: the worker; reads ``"velocity"`` and ``"skill"``, writes ``"action"``.
        discriminator: reads ``"displacement"``, writes ``"skill_logits"`` ``[E, Z]``.
        mazes: bool ``[M, H, W]``, mazes that the worker was not trained in.
        num_skills: Z.
        steps: base steps after which the figures are taken, ascending.
        seed: of the starts.

    Returns:
        For each number of steps, ``"accuracy"`` (of the discriminator at that step),
        ``"accuracy_until"`` (mean over all steps up to it), ``"displacement"`` (mean per skill,
        ``[Z][2]``, tiles) and ``"angle"`` (smallest between two of these, degrees).
    """
    num_mazes = len(mazes)
    env = WaterworldMazeEnv(mazes, observation=False, max_steps=10**9)
    generator = torch.Generator().manual_seed(seed)
    tiles = free_tiles(mazes)
    picks = torch.randint(tiles.shape[1], (num_mazes, num_skills), generator=generator)
    tile = tiles.gather(1, picks).reshape(-1)  # [E]
    start = torch.stack((tile % env.width, tile // env.width), -1) + 0.5
    # The target in the corner farther away: an episode that meets it has ended.
    low, high = torch.tensor([0.5, 0.5]), torch.tensor([env.width - 0.5, env.height - 0.5])
    near_low = (start - low).norm(dim=-1, keepdim=True) < (start - high).norm(dim=-1, keepdim=True)
    index = torch.arange(num_mazes).repeat_interleave(num_skills)
    state = env.make_state(index, start, torch.where(near_low, high, low))
    skill = torch.arange(num_skills).repeat(num_mazes)
    state.set("skill", skill)
    out: dict[int, dict[str, Any]] = {}
    hits: list[Tensor] = []
    for step in range(1, max(steps) + 1):
        after = env._step(policy(state))
        state.update(after.select("position", "velocity", "step_count"))
        displacement = state["position"] - start
        state.set("displacement", displacement)
        guess = discriminator(state.clone(False))["skill_logits"].argmax(-1)
        hits.append((guess == skill).float().mean())
        if step in steps:
            mean = displacement.view(num_mazes, num_skills, 2).mean(0)
            out[step] = {
                "accuracy": round(float(hits[-1]), 4),
                "accuracy_until": round(float(torch.stack(hits).mean()), 4),
                "displacement": [[round(float(x), 3) for x in row] for row in mean],
                "angle": round(smallest_angle(mean), 1),
            }
    return out


def smallest_angle(vectors: Tensor) -> float:
    """Return the smallest angle between two of the vectors ``[Z, 2]``, in degrees."""
    unit = torch.nn.functional.normalize(vectors.double(), dim=-1)
    cosine = (unit @ unit.T).fill_diagonal_(-1.0)
    return math.degrees(math.acos(float(cosine.max().clamp(-1.0, 1.0))))


def search_coverage(search: Search, env: WaterworldMazeEnv) -> Tensor:
    """Return which share of the tiles that it could reach each tree of a search has reached.

    A tile is reached if an option ended in it. Tiles behind the target count as out of reach: an
    episode that meets the target is over.

    Args:
        search: a finished search whose states have ``"position"``, ``"target"``, ``"maze_index"``.
        env: whose mazes the states index.

    Returns:
        float ``[B]``, one per root.
    """
    states = search.tree.states
    assert states is not None
    shares = []
    for root in range(search.num_roots):
        position = states["position"][root, : int(search.tree.num_nodes[root])]
        walls = env.mazes[int(states["maze_index"][root, 0])].clone()
        column, row = (int(x) for x in position[0])
        target_column, target_row = (int(x) for x in states["target"][root, 0])
        walls[target_row, target_column] = True
        lengths = shortest_path_lengths(walls, (row, column))
        within = torch.as_tensor(lengths) >= 0
        within[target_row, target_column] = True
        reached = torch.zeros_like(within)
        reached[position[:, 1].long(), position[:, 0].long()] = True
        shares.append((reached & within).sum() / within.sum())
    return torch.stack(shares)

"""Planning in a model, acting in a real env: tables, and mazes of another clock and friction."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import InitTracker, RenameTransform, TransformedEnv

from torchrl_hmcts.envs import DeepMindLabEnv, LabMazeEnv
from torchrl_hmcts.planners import HierarchicalPolicy, MCTSPlanner, RadiusNovelty, SearchBudget
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.transforms import OptionTransform


def renamed() -> TransformedEnv:
    """A chain that calls its state ``place``."""
    return TransformedEnv(
        ChainEnv(6), RenameTransform(in_keys=["state"], out_keys=["place"], create_copy=True)
    )


def test_a_map_makes_the_models_state_from_what_the_real_env_shows() -> None:
    calls = []

    def state_map(td: TensorDictBase) -> TensorDict:
        calls.append(td["place"].item())
        return TensorDict({"state": td["place"]}, td.batch_size)

    policy = HierarchicalPolicy(MCTSPlanner(ChainEnv(6)), state_map=state_map, replan_every=1)
    real = renamed().append_transform(InitTracker())
    rollout = real.rollout(20, policy=policy)
    assert rollout["action"].tolist() == [1] * 5
    assert calls == [0, 1, 2, 3, 4]
    assert rollout["plan_length"].flatten().tolist() == [5, 4, 3, 2, 1]


def test_a_real_env_with_other_options_is_refused() -> None:
    with pytest.raises(ValueError, match="options of the real env and of the model must be"):
        HierarchicalPolicy(MCTSPlanner(ChainEnv(6)), env=LabMazeEnv(maze_seeds=[1]), replan_every=1)


def test_a_real_env_that_does_not_show_the_state_is_refused() -> None:
    state_map = TensorDictModule(lambda place: place, ["place"], ["state"])
    with pytest.raises(ValueError, match=r"reads \['place'\], which ChainEnv does not write"):
        HierarchicalPolicy(
            MCTSPlanner(ChainEnv(6)), state_map=state_map, env=ChainEnv(6), replan_every=1
        )


@pytest.mark.parametrize(
    ("state_map", "message"),
    [
        (lambda td: TensorDict({}, td.batch_size), r"without \['state'\]"),
        (lambda td: td.select("state").expand(2), r"got batch size \[2\]"),
    ],
)
def test_a_map_that_returns_no_state_is_refused(state_map: Any, message: str) -> None:
    policy = HierarchicalPolicy(MCTSPlanner(ChainEnv(6)), state_map=state_map, replan_every=1)
    with pytest.raises(ValueError, match=message):
        policy(ChainEnv(6).reset())


# ---------------------------------------------------------------------- the maze


def towards(skill: Tensor, heading: Tensor) -> Tensor:
    """The key that pushes most to the east, north, west or south."""
    cosine, sine = heading.unbind(-1)
    forward, left = torch.stack((cosine, sine), -1), torch.stack((-sine, cosine), -1)
    keys = torch.stack((forward, -forward, left, -left), -2)  # in the order of LAB_ACTIONS
    wanted = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[skill]
    return (keys * wanted.unsqueeze(-2)).sum(-1).argmax(-1)


WORKER = TensorDictModule(towards, ["skill", "heading"], ["action"])


def options(env: Any) -> TransformedEnv:
    return TransformedEnv(env, OptionTransform(WORKER, 4, 40))


def planner_over(model: LabMazeEnv) -> MCTSPlanner:
    return MCTSPlanner(
        options(model),
        novelty=RadiusNovelty("tile_position", 0.5, shorter_paths=True),
        leaves_per_wave=4,
        budget=SearchBudget(expansions=400, until_plan=True),
    )


MAZES = ["*********", "*P    * *", "* *** * *", "* *   * *", "* * ***G*", "* *     *", "*********"]


@pytest.mark.parametrize("mapped", [False, True])
def test_a_maze_is_solved_though_the_models_clock_and_friction_are_others(mapped: bool) -> None:
    """17 ms frames beside 16, and 5 % more friction: open loop, a plan would miss the corners."""
    model = LabMazeEnv([MAZES])
    real = LabMazeEnv([MAZES], fps=57, friction=6.3)
    assert (real.frame_msec, model.frame_msec) == (17, 16)

    def state_map(td: TensorDictBase) -> TensorDict:
        """As from an engine: place, heading and velocity only."""
        heading = torch.rad2deg(torch.atan2(td["heading"][..., 1], td["heading"][..., 0]))
        return model.make_state(0, td["position"], heading, velocity=td["velocity"])

    macro = options(real)
    policy = HierarchicalPolicy(
        planner_over(model), state_map=state_map if mapped else None, env=macro, replan_every=1
    )
    start = macro.reset(
        real.make_state(0, [[150.0, 550.0]] * 3, heading=[0.0, 40.0, 200.0]), set_state=True
    )
    rollout = macro.rollout(
        60, policy=policy, tensordict=start, auto_reset=False, break_when_all_done=True
    )
    assert rollout["next", "terminated"].any(1).all()
    last = rollout["num_plans"].squeeze(-1).amax(1)
    assert (last > 5).all()  # planned after every option


def test_the_adapter_of_the_real_engine_takes_the_real_envs_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = Path(__file__).parent / "lab_stand_in.py"
    spec = importlib.util.spec_from_file_location("lab_stand_in", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(sys.modules, "deepmind_lab", module)
    engine = DeepMindLabEnv(level="nine", rows=9, columns=9, maze_seeds=[1], seed=0)
    macro = options(engine)
    policy = HierarchicalPolicy(planner_over(engine.model), env=macro, replan_every=1)
    rollout = macro.rollout(80, policy=policy)
    assert rollout["next", "terminated"][-1].item()
    assert rollout["next", "reward"][-1].item() > 0

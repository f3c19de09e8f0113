"""What all mazes to move in promise: states, seeds, batches, specs and refusals."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter
from torchrl.envs import TransformedEnv as Transformed
from torchrl.envs.utils import check_env_specs

from torchrl_hmcts.envs import (
    GridworldMazeEnv,
    LabMazeEnv,
    WaterworldMazeEnv,
    generate_mazes,
    maze_from_text,
    maze_pool,
)
from torchrl_hmcts.envs.lab.read_outs import READ_OUTS

LAB = {"maze_seeds": range(5), "num_steps": 3, "read_outs": READ_OUTS}
MAKE: dict[str, Callable[..., EnvBase]] = {
    "waterworld": partial(WaterworldMazeEnv, maze_pool("test")[:5]),
    "gridworld": partial(GridworldMazeEnv, maze_pool("test")[:5]),
    "lab": partial(LabMazeEnv, **LAB, terminate_on_goal=False),
    "lab_exact": partial(LabMazeEnv, **LAB, terminate_on_goal=False, clock="exact"),
    "lab_native": partial(LabMazeEnv, **LAB, actions=None),
}
TILES = ["waterworld", "gridworld"]
LIMIT = {"waterworld": "max_steps", "gridworld": "max_steps", "lab": "max_frames"}
BATCHES = [[], [3], [2, 4]]
each = pytest.mark.parametrize("name", MAKE)
each_kind = pytest.mark.parametrize("name", LIMIT)


def state_keys(env: EnvBase) -> list[str]:
    return list(env.state_spec.keys())


def actions(env: EnvBase, *batch: int) -> torch.Tensor:
    drawn = [env.action_spec.rand() for _ in range(torch.Size(batch).numel())]
    return torch.stack(drawn).reshape((*batch, *env.action_spec.shape))


def play(env: Any, td: Any, taken: Any) -> list[Any]:
    """What each step writes."""
    steps = []
    for action in taken:
        td = env._step(td.copy().set("action", action))
        steps.append(td)
    return steps


def run(env: Any, batch: list[int], count: int) -> tuple[list[Any], torch.Tensor, list[Any]]:
    """States, actions (each held for some steps), and what each step wrote."""
    td = env.reset(TensorDict(batch_size=batch))
    taken = actions(env, count, *batch)
    for i in range(1, count):
        if i % 8:
            taken[i] = taken[i - 1]
    steps = play(env, td, taken)
    return [s.select(*state_keys(env)).clone() for s in (td, *steps[:-1])], taken, steps


@each
@pytest.mark.parametrize("batch", BATCHES)
def test_set_to_a_state_and_stepped_equals_the_unbroken_run(name: str, batch: list[int]) -> None:
    """Bit for bit, in any order of states: nothing is kept between steps."""
    torch.manual_seed(0)
    states, taken, unbroken = run(MAKE[name](seed=0), batch, 60)
    other = MAKE[name](seed=1)
    for t in torch.randperm(60).tolist():
        (after,) = play(other, other.reset(states[t], set_state=True), [taken[t]])
        assert (after == unbroken[t]).all()


def test_through_goals_and_new_places_too() -> None:
    make = MAKE["lab_exact"]
    env = make(seed=0)
    td = env.reset(TensorDict(batch_size=[4]))
    td["position"] = torch.from_numpy(env.layout.goal[td["maze_index"].numpy()]).clone()
    td = env.reset(td, set_state=True)
    taken = actions(env, 40, 4)
    unbroken = play(env, td, taken)
    assert torch.stack([step["reward"] for step in unbroken]).max() >= 10
    states = [td, *unbroken[:-1]]
    other = make(seed=1)
    for t in torch.randperm(40).tolist():
        state = other.reset(states[t].select(*state_keys(env)), set_state=True)
        assert (play(other, state, [taken[t]])[0] == unbroken[t]).all()


@each
def test_elements_of_a_batch_in_any_layout_step_as_they_would_alone(name: str) -> None:
    env = MAKE[name](seed=0)
    td = play(env, env.reset(TensorDict(batch_size=[2, 9])), actions(env, 10, 2, 9))[-1]
    td["action"] = actions(env, 2, 9)
    before = td.clone()
    together = env._step(td)
    assert (td == before).all()  # the input is left unchanged
    for i, j in ((0, 0), (0, 7), (1, 8)):
        assert (env._step(td[i, j]) == together[i, j]).all()
    assert (env._step(td.transpose(0, 1)).transpose(0, 1) == together).all()


@each_kind
def test_the_same_seed_gives_the_same_episodes_and_no_global_generator_is_used(name: str) -> None:
    def episodes(seed: int) -> Any:
        env = MAKE[name]()
        env.set_seed(seed)
        torch.manual_seed(0)
        return env.rollout(20, break_when_any_done=False)

    assert (episodes(3) == episodes(3)).all()
    assert not (episodes(3) == episodes(4)).all()
    env = MAKE[name](seed=0)
    before = torch.get_rng_state()
    env.reset()
    assert torch.equal(before, torch.get_rng_state())


@each_kind
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_a_copy_continues_as_the_original(name: str, duplicate: Any) -> None:
    env = MAKE[name](seed=0)
    env.rollout(3)
    twin, taken = duplicate(env), actions(env, 30)
    ends = [play(e, e.reset(), taken)[-1] for e in (env, twin)]
    assert (ends[0] == ends[1]).all()


# ------------------------------------------------------------------ TorchRL


@each
def test_specs_hold(name: str) -> None:
    batches = [()] if name == "gridworld" else [(), (2, 3)]
    for batch_size in batches:
        keywords = {"batch_size": batch_size} if batch_size else {}
        env = MAKE[name](seed=0, **keywords)
        check_env_specs(env, return_contiguous=True)
        check_env_specs(Transformed(env, Compose(StepCounter(5, "steps"), RewardSum())))
        assert env.to("cpu") is env
        assert env.rollout(3).device in (None, torch.device("cpu"))
        td = env.reset().select(*state_keys(env)).set("action", env.action_spec.rand())
        assert set(env.observation_spec.keys()) <= set(env.step(td)["next"].keys())


@pytest.mark.parametrize("name", TILES)
def test_specs_hold_without_walls_and_without_observation(name: str) -> None:
    room = generate_mazes(1, num_walls=0, density=0.0)
    for env in (MAKE[name].func(room), MAKE[name](observation=False)):  # type: ignore[attr-defined]
        check_env_specs(env)
    assert "observation" not in env.rollout(2).keys()


@each_kind
@pytest.mark.parametrize("batch", BATCHES)
def test_rollouts_of_any_batch_shape_stay_within_the_specs(name: str, batch: list[int]) -> None:
    env = MAKE[name](seed=0, **{LIMIT[name]: 6})
    td = env.rollout(
        20,
        policy=lambda td: td.set("action", actions(env, *td.shape)),
        tensordict=env.reset(TensorDict(batch_size=batch)),
        auto_reset=False,
        break_when_any_done=False,
    )
    assert td.shape == (*batch, 20)
    assert td["next", "reward"].shape == (*batch, 20, 1)
    for key in env.observation_spec.keys():
        value = td["next", key]
        assert env.observation_spec[key].expand(value.shape).is_in(value), key
    gone = td["next", "level"][..., 3] if name == "lab" else td["next", "step_count"]
    assert gone.max() == 6  # and reset afterwards


@pytest.mark.parametrize("name", TILES)
def test_every_pair_of_tiles_is_drawn_equally_often(name: str) -> None:
    env = MAKE[name].func(maze_from_text("P#.\n..T")[0][None], seed=0)  # type: ignore[attr-defined]
    td = env.reset(TensorDict(batch_size=[20_000]))
    player, target = ((td[k].long() * torch.tensor([1, 3])).sum(-1) for k in ("position", "target"))
    pairs = (player * 6 + target).bincount(minlength=36)
    assert (pairs > 0).sum() == 5 * 4
    assert ((pairs[pairs > 0] - 1000).abs() < 150).all()  # 5 standard deviations


# ------------------------------------------------------------------ what is refused


@each_kind
def test_what_is_no_state_is_refused(name: str) -> None:
    env: Any = MAKE[name](seed=0)
    with pytest.raises(ValueError, match="needs the whole state in td; missing"):
        env._reset(None, set_state=True)
    for key in state_keys(env):
        td = env.reset()
        with pytest.raises(ValueError, match=rf"missing: \['{key}'\].*make_state"):
            env.reset(td.exclude(key), set_state=True)
        other = td[key].double() if td[key].dtype != torch.float64 else td[key].float()
        with pytest.raises(ValueError, match=f'"{key}" must be torch'):
            env.reset(td.clone().set(key, other), set_state=True)
    with pytest.raises(ValueError, match=r"draws one state, got a batch \[2\]"):
        env.render(env.reset(TensorDict(batch_size=[2])))


@pytest.mark.parametrize("name", TILES)
def test_unusable_mazes_and_limits_are_refused_at_construction(name: str) -> None:
    kind: Any = MAKE[name].func  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="not connected"):
        kind(torch.tensor([[[False, True, False]]]))
    with pytest.raises(ValueError, match="max_steps >= 1; got 0"):
        kind(max_steps=0)

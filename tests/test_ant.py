"""The ant of the kit ``ant``: its symmetry is exact, its view and options, and the whole agent."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import Compose, TransformedEnv

from torchrl_hmcts.envs import MujocoBatch
from torchrl_hmcts.envs.gym.ant import (
    BODY,
    POSITIONS,
    AntView,
    AntWorker,
    body_of,
    goal_rings,
    turns,
)
from torchrl_hmcts.envs.gym.settable import make_gym
from torchrl_hmcts.modules import SkillActor
from torchrl_hmcts.trainers import HMCTS
from torchrl_hmcts.trainers.cli import main
from torchrl_hmcts.trainers.experiments.gym_settings import AntConfig
from torchrl_hmcts.trainers.experiments.kits.ant import Arena, Imagine, SkillFrame, open_arena
from torchrl_hmcts.transforms import SkillTransform

pytest.importorskip("ogbench", exc_type=ImportError)
pytest.importorskip("gymnasium_robotics", exc_type=ImportError)

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]
SLOW = {"repeat": 2, "strength": 0.3}


def arena(name: str, copies: int = 1) -> MujocoBatch:
    task = partial(Arena, **(SLOW if name.startswith("AntMaze") else {}))
    maker = partial(open_arena, name)
    return MujocoBatch(maker, task=task, batch_size=[copies], dtype=torch.float64, seed=0)


def seen(td: Any) -> np.ndarray:
    return td["physics"][..., 1:30].numpy()


@pytest.mark.parametrize("name", ["antmaze-medium-v0", "AntMaze_Medium-v5"])
def test_an_ant_with_its_legs_renamed_moves_as_the_ant_does(name: str) -> None:
    env = arena(name)
    body, action, _ = turns()
    here = env.rollout(20)["next"][:, -1].select("physics", "goal")
    here["physics"][:, 30:] = 0.0  # the solver's warm start
    there = here.clone()
    w, x, y, z = here["physics"][0, 4:8]
    half = 0.5**0.5  # half a right angle, about the vertical
    there["physics"][0, 4:8] = torch.stack((w - z, x + y, y - x, z + w)) * half
    spin = there["physics"][0, 19:22].clone()
    there["physics"][0, 19:21] = torch.stack((spin[1], -spin[0]))
    for first in (8, 22):  # joints, and how fast they turn
        legs = here["physics"][0, first : first + 8]
        bends = torch.tensor([1, -1, 1, 1, 1, -1, 1, 1], dtype=torch.float64)
        there["physics"][0, first : first + 8] = legs.roll(-2) * bends
    for _ in range(5):
        taken = env.action_spec.rand()
        here = env.step(here.set("action", taken))["next"]
        turned = torch.from_numpy(action(taken.numpy(), 1))
        there = env.step(there.set("action", turned))["next"]
        own, (cosine, sine) = body_of(seen(here))
        other, (c, s) = body_of(seen(there))
        np.testing.assert_allclose(body(own, 1), other, rtol=0, atol=1e-9)
        torch.testing.assert_close(here["physics"][:, :3], there["physics"][:, :3])
        np.testing.assert_allclose([c, s], [-sine, cosine], atol=1e-9)


def test_a_body_is_seen_alone_as_among_others() -> None:
    physics = np.random.default_rng(0).normal(size=(3, 29))
    together, _ = body_of(physics)
    assert together.shape == (3, BODY)
    for one, body in zip(physics, together, strict=True):
        np.testing.assert_allclose(body_of(one)[0], body, rtol=1e-14)


def test_a_skill_begins_where_and_as_the_ant_stands() -> None:
    frames = Compose(SkillTransform(3, max_skill_steps=4), SkillFrame())
    env = TransformedEnv(arena("antmaze-medium-v0", copies=2), frames)
    td = env.rollout(9, break_when_any_done=False)
    began = td["skill_step"].squeeze(-1) == 0
    assert began.sum() == 6
    assert (td["displacement"][began] == 0).all()
    assert (td["next", "displacement"][began].norm(dim=-1) > 0).all()
    own = torch.from_numpy(np.float32(body_of(seen(td))[0]))
    assert torch.equal(td["body"][began], own[began])
    assert not torch.equal(td["body"], own)


def test_what_is_imagined_went_as_far() -> None:
    torch.manual_seed(0)

    def state() -> dict[str, torch.Tensor]:
        return {"body": torch.randn(50, 32), "displacement": torch.randn(50, 2)}

    skill = torch.zeros(50, dtype=torch.int64)
    after = TensorDict({**state(), "skill": skill}, [50])
    td = TensorDict({**state(), "skill": skill, "action": torch.randn(50, 8), "next": after}, [50])
    out = Imagine(3, 0.5)(td)
    for key in ("displacement", ("next", "displacement"), "action", "body"):
        torch.testing.assert_close(out[key].norm(dim=-1), td[key].norm(dim=-1))
    changed = (out["action"] != td["action"]).any(-1)
    assert 10 < changed.sum() < 30  # a half of them, and of these a quarter by no turn
    assert torch.equal(out["next", "skill"], out["skill"])
    assert (out["skill"] != 0).sum() > 8


def test_an_action_lasts_some_steps_at_a_share_of_its_torque() -> None:
    plain, slow = (make_gym("AntMaze_UMaze-v5") for _ in range(2))
    view = AntView(slow, **SLOW)
    plain.reset(seed=3)
    first, _ = view.reset(seed=3)
    action = np.full(8, 0.5, np.float32)
    for _ in range(2):
        observation, *_ = plain.step(np.float32(0.3) * action)
    after, *_ = view.step(action)
    assert (after["physics"][2:] == observation["observation"][:27]).all()
    assert (after["achieved_goal"] == observation["achieved_goal"]).all()
    assert (first["desired_goal"] == observation["desired_goal"]).all()


def test_an_ant_that_walks_does_not_turn_straight_back() -> None:
    env = make_gym("antmaze-medium-v0")
    four = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    view = AntView(env, directions=four)
    assert view.reset(seed=0)[0]["action_mask"].all()  # it stands
    data: Any = env.unwrapped
    _, frame = body_of(np.concatenate((data.data.qpos, data.data.qvel)))
    data.data.qvel[:2] = 2.0 * np.array(frame)  # straight ahead
    assert view._seen()["action_mask"].tolist() == [True, True, False, True]


def test_near_the_goal_a_metre_counts_as_four_more() -> None:
    def features(x: float) -> list[float]:
        shown = {"achieved_goal": np.array([x, 1.0]), "desired_goal": np.array([0.0, 1.0])}
        return goal_rings(None, shown).tolist()  # type: ignore[arg-type]

    assert [features(x) for x in (1.0, 2.0, 9.0)] == [[1, 1, 4], [2, 1, 8], [9, 1, 16]]


def test_an_option_keeps_the_heading_it_began_with_and_half_turns_are_exact() -> None:
    torch.manual_seed(0)
    spec = Bounded(-1.0, 1.0, shape=(8,))
    worker = AntWorker(SkillActor(BODY, spec, 3, in_keys=["body"]))
    draws = np.random.default_rng(0)
    first, later = ({"physics": draws.normal(size=29)} for _ in range(2))
    body, action, _ = turns()
    assert worker.num_options == 6
    for option in (2, 3):
        worker.begin(first, option)
        taken = worker.act(later, option, draws)
        _, frame = body_of(first["physics"])
        shown = body(body_of(later["physics"], frame)[0], 2 * (option % 2))
        wanted = action(worker._skills.act(shown, 1, draws), 2 * (option % 2))
        assert (taken == wanted).all()
    lying = np.zeros(29)
    lying[3:7] = 0.0, 1.0, 0.0, 0.0  # half a turn about its length
    assert worker.ends({"physics": lying}, 0, 1)
    assert lying.shape[0] == POSITIONS + 14


def test_an_agent_learns_plans_and_lends_its_skills(tmp_path: Path) -> None:
    small: dict[str, Any] = {"hidden": 8, "expansions": 6}
    words = ["hidden=8", "expansions=6", f"out={tmp_path}"]
    assert main(["train", "kit=ant", "env.id=antmaze-medium-v0", "toy=true", *words]) == 0
    assert (tmp_path / "index.html").is_file()
    agent = HMCTS.load(tmp_path)
    assert agent.config.option_steps == 25
    assert agent.env.num_options == 6
    other = HMCTS("antmaze-large-v0", kit="ant", worker=str(tmp_path), **small)
    for own, lent in zip(agent.worker.parameters(), other.worker.parameters(), strict=True):
        assert torch.equal(own, lent)
    solution = other.solve(seed=1)
    assert solution == other.solve(seed=1)
    assert solution.simulated_steps > 0
    with pytest.raises(ValueError, match="were learned in antmaze-medium-v0"):
        HMCTS("antmaze-large-v0", kit="ant", worker=str(tmp_path))


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: HMCTS("PointMaze_UMaze-v3", kit="ant"), "has no ant: its model has 2 positions"),
        (
            lambda: HMCTS("antmaze-medium-v0", kit="labmaze"),
            "'labmaze' is not a kit of Gymnasium envs",
        ),
        (
            lambda: AntConfig(id="antmaze-medium-v0", algorithm="hmcts").check_inputs(),
            "learns by LSD with algorithm=diayn",
        ),
        (lambda: HMCTS("CartPole-v1", kit="ant"), "has no MuJoCo model"),
    ],
)
def test_what_does_not_fit_the_ant_is_named(make: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make()

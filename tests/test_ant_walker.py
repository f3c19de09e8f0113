"""The AntMaze walker: its symmetry is exact, and an action does not depend on the batch."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from torchrl_hmcts.envs import MujocoBatch
from torchrl_hmcts.transforms import SkillTransform

pytest.importorskip("ogbench", exc_type=ImportError)
pytest.importorskip("gymnasium_robotics", exc_type=ImportError)

from ant_walker import Gait, Imagine, SkillFrame, Walker, body_of, open_arena, turns  # noqa: E402
from antmaze import make_actor  # noqa: E402

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]


def arena(name: str, copies: int = 1) -> MujocoBatch:
    task = Gait.of(name).arena
    return MujocoBatch(
        lambda: open_arena(name), task=task, batch_size=[copies], dtype=torch.float64, seed=0
    )


@pytest.mark.parametrize("name", ["antmaze-medium-v0", "AntMaze_Medium-v5"])
def test_an_ant_with_its_legs_renamed_moves_as_the_ant_does(name: str) -> None:
    env = arena(name)
    body, action, _ = turns()
    one = torch.ones(1, dtype=torch.int64)
    here = env.rollout(20)["next"][:, -1].select("physics", "goal")
    here["physics"][:, 30:] = 0.0  # the solver's warm start
    there = here.clone()
    w, x, y, z = here["physics"][0, 4:8]
    half = 0.5**0.5  # half a right angle, about the vertical
    turned = torch.stack((w - z, x + y, y - x, z + w)) * half
    there["physics"][0, 4:8] = turned
    spin = there["physics"][0, 19:22].clone()
    there["physics"][0, 19:21] = torch.stack((spin[1], -spin[0]))
    for first in (8, 22):  # joints, and how fast they turn
        legs = here["physics"][0, first : first + 8]
        bends = torch.tensor([1, -1, 1, 1, 1, -1, 1, 1], dtype=torch.float64)
        there["physics"][0, first : first + 8] = legs.roll(-2) * bends
    for _ in range(5):
        taken = env.action_spec.rand()
        here = env.step(here.set("action", taken))["next"]
        there = env.step(there.set("action", action(taken, one)))["next"]
        seen, frame = body_of(here["physics"], None)
        other, turned_frame = body_of(there["physics"], None)
        torch.testing.assert_close(body(seen, one), other, rtol=0, atol=1e-9)
        torch.testing.assert_close(here["physics"][:, :3], there["physics"][:, :3])
        quarter = torch.stack((-frame[:, 1], frame[:, 0]), -1)
        torch.testing.assert_close(turned_frame, quarter)


def test_an_action_does_not_depend_on_how_many_ants_walk_beside() -> None:
    env = arena("antmaze-medium-v0", copies=9)
    torch.manual_seed(0)
    worker = Walker(make_actor())
    td = env.rollout(10)["next"][:, -1].select("physics")
    td["skill"] = torch.arange(9) % worker.num_options
    together = worker(td.clone())["action"]
    for i in range(9):
        assert torch.equal(worker(td[i].clone())["action"], together[i])


def test_a_skill_begins_where_and_as_the_ant_stands() -> None:
    env = TransformedEnv(
        arena("antmaze-medium-v0", copies=2),
        Compose(SkillTransform(3, max_skill_steps=4), SkillFrame()),
    )
    td = env.rollout(9, break_when_any_done=False)
    began = td["skill_step"].squeeze(-1) == 0
    assert began.sum() == 6
    assert (td["displacement"][began] == 0).all()
    assert (td["next", "displacement"][began].norm(dim=-1) > 0).all()
    heading = body_of(td["physics"], td["frame"])[0]
    own = body_of(td["physics"], None)[0]
    assert torch.equal(heading[began], own[began])


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

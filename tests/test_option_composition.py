"""OptionTransform with what TorchRL users put below, above and inside it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import (
    AutoResetTransform,
    CatFrames,
    Compose,
    EnvBase,
    FrameSkipTransform,
    GymEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TimeMaxPool,
    Transform,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)
from torchrl.envs.utils import (
    check_env_specs,
    step_mdp,
)

from torchrl_hmcts.testing import ChainEnv, TableEnv
from torchrl_hmcts.transforms import OptionTransform

GAMMA = 0.9


def repeat(read: str = "skill", write: str = "action") -> TensorDictModule:
    """A worker that writes what it reads."""
    return TensorDictModule(lambda skill: skill.clone(), [read], [write])


def level(name: str, below: str, max_steps: int, **kwargs: Any) -> OptionTransform:
    """Options under ``name`` whose worker repeats the action ``below``."""
    return OptionTransform(
        repeat(f"{name}_skill", below),
        2,
        max_steps,
        GAMMA,
        option_key=name,
        skill_key=f"{name}_skill",
        duration_key=f"{name}_duration",
        **kwargs,
    )


def cart_pole() -> EnvBase:
    return GymEnv("CartPole-v1", categorical_action_encoding=True)


class TestBaseSteps:
    """Sutton, Precup and Singh 1999: discount and duration count base steps on every level."""

    @pytest.mark.parametrize("batch", [[], [3], [2, 3]])
    def test_three_levels_of_options_discount_each_base_step_once(self, batch: list[int]) -> None:
        # 2 x 3 x 2 = 12 steps of reward 1, of which the chain's end cuts off all after the 10th.
        levels = [level("a", "action", 2), level("b", "a", 3), level("c", "b", 2)]
        env = TransformedEnv(ChainEnv(11, reward_per_step=1.0), Compose(*levels))
        td = env.reset(TensorDict(batch_size=batch)).set("c", torch.ones(batch, dtype=torch.int64))
        after = env.step(td)["next"]
        right = sum(GAMMA**i for i in range(10)) + GAMMA**9  # the end itself is worth 1
        torch.testing.assert_close(after["reward"], torch.full((*batch, 1), right))
        assert (after["c_duration"] == 10).all()
        assert after["done"].all()

    def test_elements_whose_options_differ_are_discounted_by_their_own_base_steps(self) -> None:
        # From state 0 the first step takes 5 base steps, from state 2 it takes 2.
        table = {(0, 0): (1, 1.0, 5), (1, 0): (3, 1.0, 1), (2, 0): (1, 1.0, 2)}
        env = TransformedEnv(TableEnv(table, terminal=[3]), level("o", "action", 4))
        td = TensorDict(state=torch.tensor([0, 1, 2]), batch_size=[3])
        td = env.reset(td, set_state=True).set("o", torch.zeros(3, dtype=torch.int64))
        after = env.step(td)["next"]
        right = [1 + GAMMA**5, 1.0, 1 + GAMMA**2]
        assert after["reward"].flatten().tolist() == pytest.approx(right)
        assert after["o_duration"].flatten().tolist() == [6, 1, 3]

    @pytest.mark.parametrize("outside", [False, True], ids=["one env", "nested envs"])
    def test_the_duration_below_may_have_any_key(self, outside: bool) -> None:
        inner = OptionTransform(repeat(), 2, 2, GAMMA, duration_key=("count", "base"))
        outer = level("outer", "option", 3)
        env: EnvBase = TransformedEnv(ChainEnv(20, reward_per_step=1.0), inner)
        if outside:
            env = TransformedEnv(env, outer, auto_unwrap=False)
        else:
            env = env.append_transform(outer)
            check_env_specs(env)
        after = env.step(env.reset().set("outer", torch.tensor(1)))["next"]
        # Six base steps of reward 1: (1 - 0.9^6) / (1 - 0.9).
        assert after["reward"].item() == pytest.approx(4.68559)
        assert after["outer_duration"].item() == 6

    def test_the_duration_below_can_be_named_where_it_cannot_be_found(self) -> None:
        def make() -> EnvBase:
            inner = OptionTransform(repeat(), 2, 2, GAMMA, duration_key="base")
            return TransformedEnv(ChainEnv(20, reward_per_step=1.0), inner)

        outer = level("outer", "option", 3, base_duration_key="base")
        env = TransformedEnv(SerialEnv(2, make), outer)
        after = env.step(env.reset().set("outer", torch.tensor([1, 1])))["next"]
        assert after["reward"].flatten().tolist() == pytest.approx([4.68559] * 2)
        assert after["outer_duration"].flatten().tolist() == [6, 6]
        with pytest.raises(ValueError, match="reads base steps from 'nothing'.*does not write"):
            TransformedEnv(ChainEnv(6), level("o", "action", 2, base_duration_key="nothing"))

    def test_a_termination_is_told_the_base_steps(self) -> None:
        told = []

        def after_four(td: TensorDictBase) -> Tensor:
            told.append(td["outer_duration"].item())
            return td["outer_duration"] >= 4

        levels = [level("o", "action", 2), level("outer", "o", 9, termination=after_four)]
        env = TransformedEnv(ChainEnv(20), Compose(*levels))
        after = env.step(env.reset().set("outer", torch.tensor(1)))["next"]
        assert told == [2, 4]
        assert after["outer_duration"].item() == 4

    def test_a_frame_skip_after_the_options_is_refused_with_what_to_do(self) -> None:
        skip = FrameSkipTransform(3)
        with pytest.raises(
            ValueError, match="without discount.*second OptionTransform.*max_steps=3"
        ):
            TransformedEnv(ChainEnv(20), Compose(level("o", "action", 2), skip)).rollout(1)

    def test_a_frame_skip_before_the_options_makes_the_base_step_longer(self) -> None:
        env = TransformedEnv(cart_pole(), Compose(FrameSkipTransform(2), level("o", "action", 3)))
        after = env.step(env.reset().set("o", torch.tensor(0)))["next"]
        assert after["reward"].item() == pytest.approx(2 * (1 + GAMMA + GAMMA**2))
        assert after["o_duration"].item() == 3


def stacked(transform: Transform, *more: Transform) -> tuple[EnvBase, EnvBase]:
    """The same env with a transform, plain and under options of four steps."""
    plain = TransformedEnv(cart_pole(), Compose(transform.clone(), *more))
    options = TransformedEnv(cart_pole(), Compose(transform, level("o", "action", 4)))
    for env in (plain, options):
        env.set_seed(0)
    return plain, options


class TestTransformsBelow:
    @pytest.mark.parametrize(
        "make",
        [
            pytest.param(
                partial(VecNorm, in_keys=["observation"]),
                marks=pytest.mark.filterwarnings("ignore:.*VecNorm:FutureWarning"),
            ),
            partial(VecNormV2, in_keys=["observation"]),
            partial(CatFrames, N=3, dim=-1, in_keys=["observation"]),
            partial(TimeMaxPool, T=3, in_keys=["observation"]),
            partial(RewardSum),
            partial(StepCounter, 7),
        ],
        ids=["VecNorm", "VecNormV2", "CatFrames", "TimeMaxPool", "RewardSum", "StepCounter"],
    )
    def test_they_do_what_they_do_without_options(self, make: Callable[[], Transform]) -> None:
        plain, options = stacked(make())
        one, two = plain.reset(), options.reset()
        for option in (0, 1, 0):
            two = options.step(two.set("o", torch.tensor(option)))
            for _ in range(two["next", "o_duration"].item()):
                one = plain.step(one.set("action", torch.tensor(option)))
                last, one = one["next"], step_mdp(one)
            same = last.exclude("reward")
            for key in same.keys():
                torch.testing.assert_close(two["next", key], same[key], msg=str(key))
            if last["done"]:
                break
            two = step_mdp(two)

    def test_what_a_normaliser_learned_in_options_is_saved_and_can_be_frozen(self) -> None:
        norm = VecNormV2(in_keys=["observation"])
        env = TransformedEnv(cart_pole(), Compose(norm, level("o", "action", 4)))
        before = norm._count["observation"].item()
        td = env.rollout(3, lambda td: td.set("o", torch.tensor(1)))
        base_steps = td["next", "o_duration"].sum().item()
        assert norm._count["observation"].item() == before + 1 + base_steps
        fresh = VecNormV2(in_keys=["observation"])
        other = TransformedEnv(cart_pole(), Compose(fresh, level("o", "action", 4)))
        other.load_state_dict(env.state_dict())
        torch.testing.assert_close(fresh.loc, norm.loc)
        loc = norm.freeze().loc.clone()
        env.rollout(3, lambda td: td.set("o", torch.tensor(1)))
        assert (norm.loc == loc).all()


class AgentsEnv(EnvBase):
    """Each of three agents goes to the right or stays; agent i earns i + 1 a step.

    An agent is done at 4. ``done_key`` says whether the env has a done of its own too.
    """

    batch_locked = False

    def __init__(self, own_done: bool) -> None:
        super().__init__(batch_size=[])
        self.own_done = own_done
        flag = {k: Binary(1, shape=(3, 1), dtype=torch.bool) for k in ("done", "terminated")}
        done = {k: Binary(1, dtype=torch.bool) for k in ("done", "terminated")}

        def group(**specs: Any) -> Composite:
            return Composite(agents=Composite(**specs, shape=(3,)))

        self.observation_spec = group(place=Bounded(0, 4, shape=(3,), dtype=torch.int64))
        self.state_spec = self.observation_spec.clone()
        self.full_action_spec = group(action=Categorical(2, shape=(3,)))
        self.full_reward_spec = group(reward=Unbounded((3, 1)))
        whole = done if own_done else {}
        self.full_done_spec = Composite(agents=Composite(**flag, shape=(3,)), **whole)

    def _agents(self, place: Tensor, **entries: Tensor) -> TensorDict:
        return TensorDict({"place": place, **entries}, batch_size=place.shape)

    def _step(self, td: TensorDictBase) -> TensorDict:
        place = (td["agents", "place"] + td["agents", "action"]).clamp_max(4)
        done = (place == 4).unsqueeze(-1)
        reward = torch.arange(1.0, 4.0).unsqueeze(-1).expand(done.shape).clone()
        out = {"agents": self._agents(place, reward=reward, done=done, terminated=done.clone())}
        if self.own_done:
            out.update({key: done.all(-2) for key in ("done", "terminated")})
        return TensorDict(out, batch_size=td.batch_size)

    def _reset(self, td: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        shape = [] if td is None else td.batch_size
        place = torch.zeros((*shape, 3), dtype=torch.int64)
        return TensorDict({"agents": self._agents(place)}, batch_size=shape)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


class TestAgents:
    @pytest.mark.parametrize("batch", [[], [2], [2, 2]])
    @pytest.mark.parametrize("own_done", [False, True])
    def test_each_has_its_option_and_its_discounted_reward(
        self, own_done: bool, batch: list[int]
    ) -> None:
        worker = TensorDictModule(
            lambda z: z.clone(), [("agents", "skill")], [("agents", "action")]
        )
        options = OptionTransform(
            worker,
            2,
            3,
            GAMMA,
            option_key=("agents", "option"),
            skill_key=("agents", "skill"),
            trajectory_keys=[("agents", "action"), ("next", "agents", "reward")],
        )
        env = TransformedEnv(AgentsEnv(own_done), options)
        check_env_specs(env)
        td = env.reset().expand(batch).clone()
        chosen = torch.tensor([1, 0, 1]).expand(*batch, 3).clone()
        td = env.step(td.set(("agents", "option"), chosen))
        after = td["next"]
        assert (after["agents", "place"] == torch.tensor([3, 0, 3])).all()
        total = 1 + GAMMA + GAMMA**2
        right = (total * torch.tensor([[1.0], [2.0], [3.0]])).expand(*batch, 3, 1)
        torch.testing.assert_close(after["agents", "reward"], right)
        # The first agent is done one base step later, which ends the options of all.
        after = env.step(step_mdp(td).set(("agents", "option"), chosen))["next"]
        assert (after["duration"] == 1).all()
        assert after["trajectory", "mask"].sum(-1).unique().tolist() == [1]

    def test_one_option_may_be_for_all(self) -> None:
        worker = TensorDictModule(
            lambda z: z.unsqueeze(-1).expand(*z.shape, 3).clone(), ["skill"], [("agents", "action")]
        )
        env = TransformedEnv(AgentsEnv(own_done=True), OptionTransform(worker, 2, 3))
        check_env_specs(env)
        after = env.step(env.reset().set("option", torch.tensor(1)))["next"]
        assert after["agents", "place"].tolist() == [3, 3, 3]


class AutoResetting(GymEnv):
    """Resets itself within the step that ends an episode."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if tensordict is not None and "_reset" in tensordict.keys():
            return self._at_reset
        return super()._reset(tensordict, **kwargs)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = super()._step(tensordict)
        if after["done"].any():
            self._at_reset = super()._reset(None)
            after.update(self._at_reset.exclude(*self.done_keys))
        return after


def vector_env() -> EnvBase:
    return GymEnv("CartPole-v1", num_envs=3, categorical_action_encoding=True)


class TestAutoReset:
    def test_several_gym_envs_in_one_are_refused(self) -> None:
        base = vector_env()
        with pytest.raises(ValueError, match=r"GymEnv steps.*its 3 elements at once.*SerialEnv\(3"):
            base.append_transform(level("o", "action", 4))
        base.close()

    def test_a_batch_that_resets_itself_is_refused(self) -> None:
        resetting = TransformedEnv(SerialEnv(2, cart_pole), AutoResetTransform())
        with pytest.raises(ValueError, match=r"steps and resets all its 2 elements at once"):
            resetting.append_transform(level("o", "action", 4))

    def test_options_of_one_step_run_in_them(self) -> None:
        env = vector_env().append_transform(level("o", "action", 1))
        after = env.rollout(3, lambda td: td.set("o", torch.ones(3, dtype=torch.int64)))["next"]
        assert (after["reward"] == 1).all()
        env.close()

    def test_one_env_that_resets_itself_ends_its_options_with_its_episodes(self) -> None:
        env = AutoResetting("CartPole-v1", categorical_action_encoding=True, auto_reset=True)
        env = env.append_transform(level("o", "action", 6))
        env.set_seed(0)
        data = env.rollout(5, lambda td: td.set("o", torch.tensor(0)), break_when_any_done=False)
        done = data["next", "done"].flatten()
        assert done.sum() > 1
        assert (data["next", "o_duration"].flatten()[~done] == 6).all()
        assert (data["next", "o_duration"].flatten()[done] < 6).all()
        begins = data["observation"][1:][done[:-1]]
        assert (begins.abs() < 0.06).all()  # CartPole's starts lie within 0.05


@pytest.mark.parametrize(
    ("ends", "got"),
    [
        (torch.zeros(2, dtype=torch.bool), r"torch.bool \[2\]"),
        (torch.zeros((), dtype=torch.int64), r"torch.int64 \[\]"),
        (False, "False"),
    ],
)
def test_a_termination_of_another_form_is_refused(ends: Any, got: str) -> None:
    options = level("o", "action", 4, termination=lambda td: ends)
    env = TransformedEnv(ChainEnv(6), options)
    message = rf"must return bool \[\] or \[1\], True where the option ends; it returned {got}"
    with pytest.raises(ValueError, match=message):
        env.step(env.reset().set("o", torch.tensor(1)))

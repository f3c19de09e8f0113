"""OptionTransform with what TorchRL users put below, above and inside it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
import torchrl
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import (
    AutoResetTransform,
    CatFrames,
    Compose,
    EnvBase,
    FrameSkipTransform,
    GymEnv,
    InitTracker,
    RewardSum,
    SerialEnv,
    StepCounter,
    TensorDictPrimer,
    TimeMaxPool,
    Transform,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)
from torchrl.envs.utils import (
    ExplorationType,
    check_env_specs,
    set_exploration_type,
    step_mdp,
)
from torchrl.modules import GRUModule, LSTMModule, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_hmcts.modules import (
    ConcatSkillMLP,
    SkillActor,
    SkillDiscriminator,
    SkillDynamics,
    SkillEncoder,
    SkillMLP,
    SkillPolicy,
    SpectralLinear,
)
from torchrl_hmcts.objectives import METRAEncoderLoss, SkillDynamicsLoss
from torchrl_hmcts.testing import ChainEnv, ContractError, TableEnv, check_worker
from torchrl_hmcts.trainers import DIAYNTrainer
from torchrl_hmcts.transforms import DisplacementTransform, OptionTransform, SkillTransform

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


class Counted(Transform):
    """Counts the observations that it has seen, in an attribute as VecNormV2 does."""

    def __init__(self) -> None:
        super().__init__(in_keys=["observation"], out_keys=[])
        self.seen = 0

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self.seen += 1
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, reset: TensorDictBase) -> TensorDictBase:
        return self._call(reset)


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

    def test_they_see_each_base_step_once_whether_nested_or_not(self) -> None:
        for wrap in (lambda *parts: Compose(*parts), lambda one, two: Compose(Compose(one), two)):
            counted = Counted()
            env = TransformedEnv(cart_pole(), wrap(counted, level("o", "action", 4)))
            counted.seen = 0
            td = env.rollout(3, lambda td: td.set("o", torch.tensor(1)))
            assert counted.seen == 1 + td["next", "o_duration"].sum()

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


def recurrent(kind: type, nested: bool) -> tuple[TensorDictSequential, Transform]:
    """A worker with a memory, and the primer with which TorchRL begins it."""
    torch.manual_seed(0)
    keys = ["memory"] if kind is GRUModule else ["memory", "cell"]
    states = [("worker", key) for key in keys] if nested else keys
    module = kind(
        3,
        8,
        in_keys=["observation", *states, "is_init"],
        out_keys=["features", *(("next", *k) if nested else ("next", k) for k in states)],
    )

    def act(features: Tensor) -> Tensor:
        return features[..., :1].tanh()

    worker = TensorDictSequential(module, TensorDictModule(act, ["features"], ["action"]))
    return worker, module.make_tensordict_primer()


MEMORY = [
    pytest.param(kind, nested, id=f"{kind.__name__}{' nested' if nested else ''}")
    for kind in (GRUModule, LSTMModule)
    for nested in (False, True)
]


class TestRecurrentWorker:
    @pytest.mark.parametrize(("kind", "nested"), MEMORY)
    @pytest.mark.parametrize("number", [0, 2], ids=["one env", "SerialEnv"])
    @pytest.mark.parametrize("memory", ["reset", "keep"])
    def test_it_remembers_all_of_its_option(
        self, kind: type, nested: bool, number: int, memory: str
    ) -> None:
        worker, primer = recurrent(kind, nested)
        key = ("worker", "memory") if nested else "memory"
        below = [InitTracker(), primer]

        def make() -> EnvBase:
            one = partial(GymEnv, "Pendulum-v1")
            return SerialEnv(number, one) if number else one()

        plain = TransformedEnv(make(), Compose(*(t.clone() for t in below)))
        options = OptionTransform(
            worker, 1, 5, trajectory_keys=[key, "action"], worker_memory=memory
        )
        env = TransformedEnv(make(), Compose(*below, options))
        check_env_specs(env)
        for one in (plain, env):
            one.set_seed(0)
        td, two = plain.reset(), env.reset()
        for _ in range(2):  # options
            if memory == "reset":
                for state in primer.primers.keys(True, True):
                    td.set(state, torch.zeros_like(td[state]))
            two = env.step(two.set("option", torch.zeros(env.batch_size, dtype=torch.int64)))
            for i in range(5):
                td = plain.step(worker(td))
                steps = two["next", "trajectory"][..., i]
                torch.testing.assert_close(steps[key], td[key])
                torch.testing.assert_close(steps["action"], td["action"])
                last, td = td["next"], step_mdp(td)
            torch.testing.assert_close(two["next", key], last[key])
            torch.testing.assert_close(two["next", "observation"], last["observation"])
            two = step_mdp(two)

    def test_without_a_primer_its_memory_stays_within_the_option(self) -> None:
        worker, _ = recurrent(GRUModule, nested=False)
        base = TransformedEnv(GymEnv("Pendulum-v1"), InitTracker())
        env = base.append_transform(OptionTransform(worker, 1, 3, trajectory_keys=["memory"]))
        check_env_specs(env)
        after = env.step(env.reset().set("option", torch.tensor(0)))["next"]
        sizes = after["trajectory", "memory"].abs().sum((-1, -2))
        assert sizes[0] == 0
        assert (sizes[1:] > 0).all()
        base = TransformedEnv(GymEnv("Pendulum-v1"), InitTracker())
        with pytest.raises(ValueError, match=r"keeps \['memory'\].*make_tensordict_primer"):
            base.append_transform(OptionTransform(worker, 1, 3, worker_memory="keep"))


class Fading(TensorDictModuleBase):
    """Acts by what it is told, half as strongly in each step; how strongly is its memory."""

    in_keys = ["told", "strength", "is_init"]
    out_keys = ["action", ("next", "strength")]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        strength = td["strength"]
        assert td["is_init"].equal(strength == 1)  # begins where its primer says
        return td.set("action", td["told"] * strength).set(("next", "strength"), strength / 2)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        strength = Composite(strength=Unbounded(1))
        return TensorDictPrimer(strength, default_value=1.0, expand_specs=True)


class StandIn(TensorDictModuleBase):
    """Calls a policy as the LowLevelController of TorchRL's nightly does.

    The policy's own entries, and ``is_init``, live under one key and are written under ``"next"``.
    """

    def __init__(self, policy: Fading, decision_spec: Composite) -> None:
        super().__init__()
        self.policy, self.decision_spec, self.state_key = policy, decision_spec, "_controller"
        self.in_keys = ["told", self.state_key]
        self.out_keys = ["action", ("next", self.state_key)]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        state = td.get(self.state_key)
        work = td.select("told").clone()
        work.update(state.clone())
        work = self.policy(work.reshape(-1)).reshape(td.batch_size)
        kept = {"strength": work["next", "strength"], "is_init": torch.zeros_like(state["is_init"])}
        return td.set("action", work["action"]).set(("next", self.state_key), TensorDict(kept))

    def make_tensordict_primer(self) -> TensorDictPrimer:
        specs = Composite(strength=Unbounded(1), is_init=Binary(1, dtype=torch.bool))
        begins = {"strength": 1.0, "is_init": True}
        return TensorDictPrimer(
            Composite({self.state_key: specs}),
            default_value={self.state_key: begins},
            expand_specs=True,
        )


@pytest.mark.parametrize("number", [0, 2], ids=["one env", "SerialEnv"])
@pytest.mark.parametrize("memory", ["reset", "keep"])
def test_torchrls_low_level_controller_is_a_worker(memory: str, number: int) -> None:
    make = getattr(torchrl.modules, "LowLevelController", StandIn)
    controller = make(Fading(), Composite(told=Bounded(-2.0, 2.0, shape=(1,))))
    table = torch.tensor([[-1.0], [2.0]])
    options = OptionTransform(
        controller,
        2,
        4,
        skill_key="told",
        skills=table,
        trajectory_keys=["action"],
        worker_memory=memory,
    )
    one = partial(GymEnv, "Pendulum-v1")
    base = SerialEnv(number, one) if number else one()
    env = base.append_transform(controller.make_tensordict_primer()).append_transform(options)
    check_env_specs(env)
    chosen = torch.arange(2) if number else torch.tensor(1)
    data = env.rollout(2, lambda td: td.set("option", chosen))
    strength = 0.5 ** torch.arange(8.0).view(2, 4)
    right = table[chosen].view(-1, 1, 1) * (strength if memory == "keep" else strength[:1])
    torch.testing.assert_close(
        data["next", "trajectory", "action"].reshape(-1, 2, 4), right.expand(-1, 2, 4)
    )


def test_a_controller_without_its_primer_or_with_another_decision_is_refused() -> None:
    controller = StandIn(Fading(), Composite(told=Bounded(-2.0, 2.0, shape=(1,))))
    table = torch.zeros(2, 1)
    bare = OptionTransform(controller, 2, 4, skill_key="told", skills=table)
    with pytest.raises(ValueError, match="append its make_tensordict_primer"):
        GymEnv("Pendulum-v1").append_transform(bare)
    env = GymEnv("Pendulum-v1").append_transform(controller.make_tensordict_primer())
    with pytest.raises(ValueError, match="if it is the option, pass skill_key='told'"):
        env.append_transform(OptionTransform(controller, 2, 4, skills=table))
    env = GymEnv("Pendulum-v1").append_transform(controller.make_tensordict_primer())
    with pytest.raises(ValueError, match="vectors of 1 numbers, but gets options as their num"):
        env.append_transform(OptionTransform(controller, 2, 4, skill_key="told"))


class Counting(torch.nn.Module):
    """Steps to one side and to the other; how many steps it took it keeps as ``where`` says."""

    def __init__(self, where: str) -> None:
        super().__init__()
        self.where, self.taken = where, 0
        self.in_keys = ["skill", *([] if where == "itself" else ["taken"])]
        self.out_keys = ["action"]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        taken = self.taken if self.where == "itself" else td["taken"]
        if self.where == "itself":
            self.taken = taken + 1
        else:
            td.set("taken" if self.where == "root" else ("next", "taken"), taken + 1)
        return td.set("action", (td["skill"] + taken) % 2)


@pytest.mark.parametrize("where", ["root", "next"])
def test_a_worker_may_keep_its_memory_in_the_tensordict(where: str) -> None:
    primer = TensorDictPrimer(taken=Unbounded((), dtype=torch.int64), expand_specs=True)
    env = TransformedEnv(cart_pole(), primer)
    worker = Counting(where)
    if where == "next":  # at the root it changes what it is given
        check_worker(worker, env, num_options=2)
    env.append_transform(OptionTransform(worker, 2, 4, trajectory_keys=["action"]))
    after = env.step(env.reset().set("option", torch.tensor(1)))["next"]
    assert after["trajectory", "action"].tolist() == [1, 0, 1, 0]
    assert after["taken"].item() == 4


def test_a_worker_that_keeps_its_memory_in_itself_fails_the_check() -> None:
    with pytest.raises(ContractError, match="keep nothing in itself|of two calls"):
        check_worker(Counting("itself"), cart_pole(), num_options=2)


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


def on_policy_worker() -> tuple[TensorDictSequential, ProbabilisticActor, ValueOperator]:
    torch.manual_seed(0)
    actor = ProbabilisticActor(
        TensorDictModule(torch.nn.Linear(4, 2), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    critic = ValueOperator(torch.nn.Linear(4, 1), in_keys=["observation"])
    return TensorDictSequential(actor, critic), actor, critic


def test_a_worker_trains_on_policy_from_what_its_options_hand_out() -> None:
    worker, actor, critic = on_policy_worker()
    kept = ["observation", "skill", "action", "action_log_prob", "state_value"]
    kept += [("next", key) for key in ("observation", "reward", "done", "terminated")]
    options = OptionTransform(worker, 1, 30, trajectory_keys=kept)
    env, plain = TransformedEnv(cart_pole(), options), cart_pole()
    check_env_specs(env)
    starts = []
    for one in (env, plain):
        one.set_seed(0)
        starts.append(one.reset())
    with set_exploration_type(ExplorationType.RANDOM):
        torch.manual_seed(0)
        td = env.step(starts[0].set("option", torch.tensor(0)))
        torch.manual_seed(0)
        expected = plain.rollout(30, worker, auto_reset=False, tensordict=starts[1]).detach()
    block = td["next", "trajectory"]
    data = block[block["mask"]]
    assert (data["skill"] == 0).all()
    assert len(data) == len(expected) == td["next", "duration"].item()
    loss = ClipPPOLoss(actor, critic)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    losses = [loss(advantage(one.exclude("state_value"))) for one in (data, expected)]
    for key in ("action_log_prob", "advantage", "value_target"):
        kept_one, plain_one = (advantage(one.clone())[key] for one in (data, expected))
        torch.testing.assert_close(kept_one, plain_one)
    for key in ("loss_objective", "loss_critic", "loss_entropy"):
        torch.testing.assert_close(losses[0][key], losses[1][key])


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


def test_more_options_than_a_worker_has_skills_are_refused() -> None:
    actor = SkillActor(4, Categorical(2), num_skills=3, in_keys=["observation"])
    with pytest.raises(ValueError, match="has 3 skills, but there are 4 options.*num_options=3"):
        TransformedEnv(cart_pole(), OptionTransform(SkillPolicy(actor), 4, 5))


def test_float64_observations_are_read_in_the_precision_of_the_networks() -> None:
    seen = torch.randn(5, 4, dtype=torch.float64)
    td = TensorDict(observation=seen, skill=torch.arange(5) % 3, batch_size=[5])
    keys: dict[str, Any] = {"in_keys": ["observation"]}
    for network in (
        SkillActor(4, Bounded(-1.0, 1.0, shape=(2,)), 3, **keys).module[0],
        SkillActor(4, Categorical(2), 3, network=ConcatSkillMLP, **keys).module[0],
        SkillDiscriminator(4, 3, **keys),
        SkillEncoder(4, 3, linear=SpectralLinear, **keys),
    ):
        with torch.no_grad():  # a spectral norm takes a step of its iteration with gradients
            double = network(td.clone())
            single = network(td.clone().set("observation", seen.float()))
        for key in network.out_keys:
            assert double[key].dtype == torch.float32
            assert double[key].equal(single[key]), key
    narrow = Bounded(-1.0, 1.0, shape=(2,), dtype=torch.float64)
    assert SkillPolicy(SkillActor(4, narrow, 3, **keys))(td)["action"].dtype == torch.float64


def test_skills_are_learned_in_mujoco_as_it_is() -> None:
    pytest.importorskip("mujoco")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of MuJoCo, about its own models
        base = GymEnv("HalfCheetah-v5")
        assert base.observation_spec["observation"].dtype == torch.float64
        env = base.append_transform(SkillTransform(3, 10))
        env.append_transform(DisplacementTransform("observation"))
        for make in (
            lambda: None,
            lambda: METRAEncoderLoss(SkillEncoder(17, 3, in_keys=["observation"])),
            lambda: SkillDynamicsLoss(
                SkillDynamics(17, 17, 3, in_keys=["observation"], target_key="observation")
            ),
        ):
            loss = DIAYNTrainer.make_loss(env, objective=make(), seed=0)
            trainer = DIAYNTrainer(env, loss, total_frames=64, batch_size=16, seed=0)
            trainer.train()
            assert all(math.isfinite(x[-1]) for x in trainer.history.values())
            assert trainer.replay_buffer[:]["next", "reward"].dtype == torch.float32


@pytest.mark.parametrize(
    ("features", "dtype", "message"),
    [
        (3, torch.float32, r"for 3 features of torch.float32 was given 4.*in_features=4"),
        (4, torch.int64, r"of torch.float32 was given 4 of torch.int64.*DTypeCastTransform"),
    ],
)
@pytest.mark.parametrize("kind", ["actor", "discriminator", "concatenated"])
def test_a_network_that_does_not_fit_what_it_reads_says_so(
    features: int, dtype: torch.dtype, message: str, kind: str
) -> None:
    keys = {"in_keys": ["observation"]}
    if kind == "discriminator":
        module: torch.nn.Module = SkillDiscriminator(features, num_skills=3, **keys)
    else:
        network = SkillMLP if kind == "actor" else ConcatSkillMLP
        module = SkillActor(features, Categorical(2), num_skills=3, network=network, **keys)
    given = 4 if features == 3 else features
    message = message if kind != "concatenated" else "was given"
    seen = torch.zeros(5, given, dtype=dtype)
    td = TensorDict(observation=seen, skill=torch.zeros(5, dtype=torch.int64))
    with pytest.raises(ValueError, match=message):
        module(td.auto_batch_size_(1))

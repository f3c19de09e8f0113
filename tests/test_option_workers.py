"""Workers of options: with a memory, of TorchRL's nightly, trained on policy, unfit ones."""

from __future__ import annotations

from functools import partial

import pytest
import torch
import torchrl
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    InitTracker,
    SerialEnv,
    TensorDictPrimer,
    Transform,
    TransformedEnv,
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
    SkillActor,
    SkillPolicy,
)
from torchrl_hmcts.testing import ContractError, check_worker
from torchrl_hmcts.transforms import OptionTransform


def cart_pole() -> EnvBase:
    return GymEnv("CartPole-v1", categorical_action_encoding=True)


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


def test_more_options_than_a_worker_has_skills_are_refused() -> None:
    actor = SkillActor(4, Categorical(2), num_skills=3, in_keys=["observation"])
    with pytest.raises(ValueError, match="has 3 skills, but there are 4 options.*num_options=3"):
        TransformedEnv(cart_pole(), OptionTransform(SkillPolicy(actor), 4, 5))

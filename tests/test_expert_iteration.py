"""The loss, the networks and the trainer of a manager that learns from its searches."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_from_text
from torchrl_hmcts.objectives import ExpertIterationLoss
from torchrl_hmcts.planners import (
    PUCT,
    MCTSPlanner,
    ModulePrior,
    PolicyValueEvaluator,
    ValueEvaluator,
)
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers import (
    ExpertIterationTrainer,
    MazeNetwork,
    SearchCollector,
    make_guided_planner,
    shortest_distances,
)


class TwoHeads(nn.Module):
    """Logits and a value in (0, 1) from the place in a chain; counts its calls."""

    def __init__(self, size: int = 16) -> None:
        super().__init__()
        self.table = nn.Embedding(size, 3)
        self.calls = 0

    def forward(self, state: Tensor) -> tuple[Tensor, Tensor]:
        self.calls += 1
        out = self.table(state.reshape(-1))
        return out[:, :2], out[:, 2:].sigmoid()


def two_heads(out_keys: list | None = None) -> TensorDictModule:
    return TensorDictModule(TwoHeads(), ["state"], out_keys or ["logits", "state_value"])


class Given(nn.Module):
    """Writes the logits and values it was built with."""

    def __init__(self, logits: Tensor, value: Tensor) -> None:
        super().__init__()
        self.logits, self.value = nn.Parameter(logits), nn.Parameter(value)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.logits, self.value


def given(logits: list, values: list, out_keys: list | None = None) -> TensorDictModule:
    net = Given(torch.tensor(logits).double(), torch.tensor(values).double()[:, None])
    return TensorDictModule(net, ["observation"], out_keys or ["logits", "state_value"])


def examples(**entries: list) -> TensorDict:
    td = TensorDict(observation=torch.zeros(2, 1), batch_size=[2])
    td["policy_target"] = torch.tensor([[1.0, 0.0], [0.25, 0.75]]).double()
    td["value_target"] = torch.tensor([[1.0], [0.5]]).double()
    for key, value in entries.items():
        td[key] = torch.tensor(value)
    return td


LOGITS = [[math.log(3.0), 0.0], [0.0, 0.0]]  # probabilities 3/4, 1/4 and 1/2, 1/2
POLICY = [-math.log(0.75), math.log(2.0)]


# ---------------------------------------------------------------------------------------- the loss


def test_the_policy_loss_is_the_closed_form_cross_entropy() -> None:
    out = ExpertIterationLoss(given(LOGITS, [0.8, 0.4]), reduction="none")(examples())
    torch.testing.assert_close(out["loss_policy"], torch.tensor(POLICY).double())
    # Entropy of (1/4, 3/4); the divergence of the first target is its cross-entropy.
    entropy = -(0.25 * math.log(0.25) + 0.75 * math.log(0.75))
    expected = torch.tensor([POLICY[0], POLICY[1] - entropy]).double()
    torch.testing.assert_close(out["policy_divergence"], expected)
    assert out["policy_accuracy"].tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("l2", [0.04, 0.01]),
        ("smooth_l1", [0.02, 0.005]),
        ("log", [0.5 * math.log(0.8) ** 2, 0.5 * math.log(0.8) ** 2]),
        ("cross_entropy", [-math.log(0.8), -0.5 * math.log(0.4) - 0.5 * math.log(0.6)]),
    ],
)
def test_value_losses_have_their_closed_forms(name: str, expected: list[float]) -> None:
    net = given(LOGITS, [0.8, 0.4])
    loss = ExpertIterationLoss(net, value_loss=name, value_coeff=2.0, reduction="none")
    out = loss(examples())
    torch.testing.assert_close(out["loss_value"], 2.0 * torch.tensor(expected).double())
    torch.testing.assert_close(out["value_error"], torch.tensor([0.2, 0.1]).double())


def test_the_log_loss_of_discounted_distances_counts_base_steps() -> None:
    gamma, steps, goal = 0.99, [10.0, 400.0], [13.0, 397.0]
    net = given(LOGITS, [gamma**n for n in steps])
    td = examples()
    td["value_target"] = torch.tensor([[gamma**n] for n in goal]).double()
    out = ExpertIterationLoss(net, value_loss="log", reduction="none")(td)
    off = 0.5 * (3.0 * math.log(gamma)) ** 2
    torch.testing.assert_close(out["loss_value"], torch.tensor([off, off]).double())


def test_a_value_of_zero_gives_a_finite_log_loss() -> None:
    net = given(LOGITS, [0.0, 1e-40])
    out = ExpertIterationLoss(net, value_loss="log")(examples())
    out["loss_value"].backward()
    assert torch.isfinite(out["loss_value"])
    assert torch.isfinite(net.module.value.grad).all()


@pytest.mark.parametrize(("reduction", "factor"), [("mean", 0.5), ("sum", 1.0)])
def test_reductions_are_over_all_examples(reduction: str, factor: float) -> None:
    td = examples(policy_weight=[1.0, 0.0], value_weight=[0.0, 3.0])
    out = ExpertIterationLoss(given(LOGITS, [0.8, 0.4]), reduction=reduction)(td)
    assert out.batch_size == torch.Size([])
    assert out["loss_policy"].item() == pytest.approx(factor * POLICY[0])
    assert out["loss_value"].item() == pytest.approx(factor * 3.0 * 0.01)
    # Diagnostics are over the examples that have a weight.
    assert out["policy_accuracy"].item() == 1.0
    assert out["value_error"].item() == pytest.approx(0.1)


def test_forbidden_options_have_no_share_of_the_softmax() -> None:
    # With the first of three options forbidden, the other two have 1/3 and 2/3.
    net = given([[9.0, 0.0, math.log(2.0)], [9.0, 0.0, 0.0]], [0.5, 0.5])
    td = examples(action_mask=[[False, True, True], [False, True, False]])
    td["policy_target"] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]).double()
    out = ExpertIterationLoss(net, reduction="none")(td)
    torch.testing.assert_close(out["loss_policy"], torch.tensor([math.log(1.5), 0.0]).double())
    out["loss_policy"].sum().backward()
    assert torch.isfinite(net.module.logits.grad).all()
    assert net.module.logits.grad[:, 0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("name", ["l2", "smooth_l1", "log", "cross_entropy"])
def test_gradients_agree_with_finite_differences(name: str) -> None:
    net = given([[0.3, -0.2], [1.0, 0.4]], [0.8, 0.4])
    loss = ExpertIterationLoss(net, value_loss=name)
    td = examples(policy_weight=[1.0, 0.5], value_weight=[0.3, 1.0])

    def total() -> Tensor:
        out = loss(td.clone())
        return out["loss_policy"] + out["loss_value"]

    total().backward()
    for parameter in (net.module.logits, net.module.value):
        flat, step = parameter.data.view(-1), 1e-6
        for i in range(flat.numel()):
            flat[i] += step
            up = total().item()
            flat[i] -= 2 * step
            down = total().item()
            flat[i] += step
            assert parameter.grad.view(-1)[i].item() == pytest.approx(
                (up - down) / (2 * step), abs=1e-6
            )


@pytest.mark.parametrize("nested", [False, True])
def test_every_key_can_be_renamed(nested: bool) -> None:
    names = {
        key: ("inner", f"my_{key}") if nested else f"my_{key}"
        for key in ("logits", "state_value", "policy_target", "policy_weight", "value_target",
                    "value_weight", "action_mask")
    }  # fmt: skip
    entries = {
        "policy_weight": [1.0, 0.5],
        "value_weight": [0.5, 1.0],
        "action_mask": [[True, False], [True, True]],
    }
    td = examples(**entries)
    expected = ExpertIterationLoss(given(LOGITS, [0.8, 0.4]))(td)
    net = given(LOGITS, [0.8, 0.4], [names["logits"], names["state_value"]])
    loss = ExpertIterationLoss(net)
    loss.set_keys(**names)
    renamed = TensorDict(observation=td["observation"], batch_size=[2])
    for key, name in names.items():
        if key in td.keys():
            renamed[name] = td[key]
    out = loss(renamed)
    for key in expected.keys():
        torch.testing.assert_close(out[key], expected[key])
    assert names["value_target"] in loss.in_keys
    with pytest.raises(KeyError, match="my_policy_target"):
        loss(td)


def test_the_loss_takes_tensors_by_keyword() -> None:
    loss = ExpertIterationLoss(given(LOGITS, [0.8, 0.4]))
    td = examples()
    out = loss(**{key: td[key] for key in loss.in_keys})
    expected = loss(td)
    assert [x.item() for x in out] == [expected[key].item() for key in loss.out_keys]


def test_it_trains_the_network_it_was_given() -> None:
    net = given(LOGITS, [0.8, 0.4])
    loss = ExpertIterationLoss(net)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    before = net.module.logits.detach().clone()
    sum(v for k, v in loss(examples()).items() if k.startswith("loss")).backward()
    optimizer.step()
    assert not torch.equal(net.module.logits, before)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"value_loss": "l3"}, "l3"),
        ({"value_coeff": -1.0}, "-1.0"),
        ({"value_coeff": math.nan}, "nan"),
        ({"reduction": "median"}, "median"),
    ],
)
def test_the_loss_refuses_what_makes_no_sense(kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ExpertIterationLoss(two_heads(), **kwargs)


@pytest.mark.parametrize("value_coeff", [0.0, 0.5])
def test_the_value_counts_as_much_as_its_coefficient_says(value_coeff: float) -> None:
    # Squared errors of 0.2 and 0.1: a mean of 0.025.
    loss = ExpertIterationLoss(given(LOGITS, [0.8, 0.4]), value_coeff=value_coeff)
    assert loss(examples())["loss_value"].item() == pytest.approx(value_coeff * 0.025)


# --------------------------------------------------------------------------- one call for two heads


def test_a_policy_value_evaluator_grows_the_tree_of_two_separate_evaluators() -> None:
    env, net = ChainEnv(length=7), two_heads()
    guide = PolicyValueEvaluator(net)
    kwargs = {"tree_policy": PUCT(c=1.0), "expand": "one"}
    joint = MCTSPlanner(env, leaf_evaluator=guide, **kwargs)
    apart = MCTSPlanner(
        env, leaf_evaluator=ValueEvaluator(net), option_prior=ModulePrior(net), **kwargs
    )
    trees = [p.search(env.reset()).tree for p in (joint, apart)]
    counts = [int(t.num_nodes[0]) for t in trees]
    assert counts[0] == counts[1] > 7
    for field in ("visits", "value", "option"):
        assert (trees[0].nodes[field][0, :7] == trees[1].nodes[field][0, :7]).all()
    assert (trees[0].edges["prior"][0, :7] == trees[1].edges["prior"][0, :7]).all()


def test_a_policy_value_evaluator_calls_its_network_once_per_wave() -> None:
    env, net = ChainEnv(length=7), two_heads()
    guide = PolicyValueEvaluator(net)
    waves = []
    planner = MCTSPlanner(env, leaf_evaluator=guide, progress=waves.append)
    planner.search(env.reset())
    assert net.module.calls == len(waves) + 1  # the root is evaluated, too


def test_the_prior_is_sharpened_and_mixed_with_the_uniform_one() -> None:
    module = TensorDictModule(
        lambda x: (x, x[:, :1]), in_keys=["x"], out_keys=["logits", "state_value"]
    )
    td = TensorDict(x=torch.tensor([[math.log(4.0), 0.0]]), batch_size=[1])
    # exp(ln 4 / 2) = 2: probabilities 2/3 and 1/3; mixed half and half with 1/2.
    prior = PolicyValueEvaluator(module, temperature=2.0, uniform_share=0.5)(td).priors
    torch.testing.assert_close(prior, torch.tensor([[7 / 12, 5 / 12]]))


def test_a_policy_value_evaluator_names_what_is_wrong() -> None:
    with pytest.raises(TypeError, match="Linear"):
        PolicyValueEvaluator(nn.Linear(1, 1))
    with pytest.raises(ValueError, match="state_value"):
        PolicyValueEvaluator(TensorDictModule(nn.Linear(1, 1), ["x"], ["logits"]))
    for kwargs in ({"temperature": 0.0}, {"uniform_share": 1.5}):
        with pytest.raises(ValueError, match=next(iter(kwargs))):
            PolicyValueEvaluator(two_heads(), **kwargs)


# ------------------------------------------------------------------------------------- the networks


def test_distances_are_shortest_paths() -> None:
    costs = torch.ones(1, 8, 3, 3)
    start = torch.full((1, 3, 3), 99.0)
    start[0, 0, 0] = 0.5
    # Moves over corners cost as much as others: the larger coordinate counts.
    expected = 0.5 + torch.tensor([[0.0, 1.0, 2.0], [1.0, 1.0, 2.0], [2.0, 2.0, 2.0]])
    torch.testing.assert_close(shortest_distances(costs, start)[0], expected)


def test_a_costly_tile_is_gone_around() -> None:
    # Neighbours are (dy, dx) row by row: 3 is to the left, 4 to the right, 1 up, 6 down.
    costs = torch.full((1, 8, 2, 3), 50.0)
    costs[:, [1, 3, 4, 6]] = 1.0
    costs[0, :, 0, 2] = torch.tensor([50.0, 50, 50, 50, 50, 50, 1, 50])  # only down
    start = torch.full((1, 2, 3), 99.0)
    start[0, 0, 0] = 0.0
    assert shortest_distances(costs, start)[0, 0, 2].item() == 4.0


def test_gradients_of_distances_flow_along_the_shortest_paths() -> None:
    generator = torch.Generator().manual_seed(3)
    costs = torch.rand(2, 8, 3, 4, generator=generator, dtype=torch.float64) + 0.1
    start = torch.full((2, 3, 4), 99.0, dtype=torch.float64)
    start[0, 0, 1], start[1, 2, 3], start[1, 0, 0] = 0.2, 0.0, 0.4
    costs.requires_grad_()
    start.requires_grad_()
    assert torch.autograd.gradcheck(shortest_distances, (costs, start), eps=1e-7)


def test_distances_refuse_costs_of_another_maze() -> None:
    with pytest.raises(ValueError, match=r"\[1, 8, 2, 3\]"):
        shortest_distances(torch.ones(1, 8, 2, 3), torch.ones(1, 3, 3))


@pytest.fixture
def env() -> WaterworldMazeEnv:
    mazes = [maze_from_text(text)[0] for text in ("..#\n...\n#..", "#..\n...\n..#")]
    return WaterworldMazeEnv(torch.stack(mazes), observation=False, seed=0)


def test_kept_distances_give_what_computed_ones_give(env: WaterworldMazeEnv) -> None:
    net = MazeNetwork(env.mazes)
    td = env.reset(TensorDict(batch_size=[40]))
    with_grad = net(td.clone())
    for _ in range(2):  # computed, then kept
        with torch.no_grad():
            kept = net(td.clone())
        for key in net.out_keys:
            torch.testing.assert_close(kept[key], with_grad[key].detach())
    with torch.no_grad():  # the rows of a batch do not mix
        alone = torch.cat([net(td[i : i + 1].clone())["logits"] for i in range(40)])
    torch.testing.assert_close(alone, kept["logits"])


def test_kept_distances_are_dropped_when_a_weight_changes(env: WaterworldMazeEnv) -> None:
    net = MazeNetwork(env.mazes)
    td = env.reset(TensorDict(batch_size=[4]))
    with torch.no_grad():
        before = net(td.clone())["state_value"]
        net.costs[-1].bias.add_(1.0)
        after = net(td.clone())["state_value"]
    assert (after < before).all()  # every move costs more


def test_a_network_is_used_in_other_mazes_with_the_same_weights(env: WaterworldMazeEnv) -> None:
    net = MazeNetwork(env.mazes)
    other = net.on(env.mazes.flip(0))
    td = env.reset(TensorDict(batch_size=[10]))
    swapped = td.clone().set("maze_index", 1 - td["maze_index"])
    with torch.no_grad():
        torch.testing.assert_close(other(swapped)["logits"], net(td.clone())["logits"])
        next(iter(net.parameters())).add_(1.0)
        torch.testing.assert_close(other(swapped)["logits"], net(td.clone())["logits"])
    assert not any("free" in key or "maze" in key for key in net.state_dict())


@pytest.mark.parametrize("shape", [[], [3], [2, 3]])
def test_the_network_takes_any_batch_shape(env: WaterworldMazeEnv, shape: list[int]) -> None:
    net = MazeNetwork(env.mazes, num_options=5)
    td = net(env.reset(TensorDict(batch_size=shape)))
    assert td["logits"].shape == (*shape, 5)
    assert td["state_value"].shape == (*shape, 1)
    assert ((td["state_value"] > 0) & (td["state_value"] < 1)).all()


def test_a_network_is_refused_without_mazes_or_with_a_wrong_discount() -> None:
    with pytest.raises(ValueError, match=r"\[3, 3\]"):
        MazeNetwork(torch.zeros(3, 3, dtype=torch.bool))
    for kwargs in ({"gamma": 1.0}, {"steps_per_tile": 0.0}):
        with pytest.raises(ValueError, match=next(iter(kwargs))):
            MazeNetwork(torch.zeros(1, 3, 3, dtype=torch.bool), **kwargs)


# ------------------------------------------------------------------------------------- the trainer


def make_trainer(**kwargs: object) -> ExpertIterationTrainer:
    torch.manual_seed(0)
    env = ChainEnv(length=8)
    settings = {"iterations": 2, "searches_per_iteration": 1, "updates_per_iteration": 60}
    return ExpertIterationTrainer(
        env, two_heads(), MCTSPlanner(env), **{"lr": 0.1, **settings, **kwargs}
    )


def test_a_search_needs_no_detour_after_it_learned_from_one() -> None:
    trainer = make_trainer()
    trainer.train()
    first, second = trainer.collector.simulations
    assert second == 7  # the length of the plan
    assert first > 5 * second
    assert trainer.collector.solved == [1, 1]
    assert trainer.collector.base_steps == [first, second]  # of one base step each
    values = trainer.network(ChainEnv(length=8).reset().reshape(1))["state_value"]
    assert values.item() == pytest.approx(0.99**6, abs=0.06)
    assert trainer.history["policy_accuracy"][-1] == 1.0


def test_training_repeats_with_its_seed() -> None:
    weights = []
    for _ in range(2):
        trainer = make_trainer(updates_per_iteration=30)
        trainer.train()
        weights.append(trainer.network.module.table.weight.detach().clone())
    assert torch.equal(*weights)


def test_a_run_that_was_stopped_and_loaded_is_the_run_that_never_stopped(tmp_path: Path) -> None:
    whole = make_trainer()
    whole.train()
    first = make_trainer(save_dir=tmp_path, save_trainer_interval=0)
    first.register_op("post_steps_log", lambda batch: first.request_stop("enough"))
    first.train()
    assert len(first.collector.solved) == 1
    second = make_trainer(save_dir=tmp_path).load(tmp_path)
    second.train()
    assert second.collector.simulations == whole.collector.simulations
    assert second.history == whole.history
    for a, b in zip(second.network.parameters(), whole.network.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_run_that_came_to_its_end_has_a_checkpoint_of_it(tmp_path: Path) -> None:
    trainer = make_trainer(save_dir=tmp_path)
    trainer.train()
    assert make_trainer().load(tmp_path).collected_frames == trainer.collected_frames > 0


def test_a_collector_goes_on_where_another_stopped() -> None:
    env = ChainEnv(length=5)
    planner = MCTSPlanner(env)
    kwargs = {"iterations": 3, "searches": 2, "keys": ["state"]}
    whole = SearchCollector(env, planner, planner, **kwargs)
    batches = list(whole)
    begun = SearchCollector(env, planner, planner, **kwargs)
    begun.collect()
    resumed = SearchCollector(env, planner, planner, **kwargs)
    resumed.load_state_dict(copy.deepcopy(begun.state_dict()))
    rest = list(resumed)
    assert len(rest) == 2
    assert resumed.state_dict() == whole.state_dict()
    for one, other in zip(rest, batches[1:], strict=True):
        assert (one == other).all()


def test_progress_is_shown_and_closed() -> None:
    calls: list[object] = []

    class Bar:
        def __init__(self, total: int) -> None:
            calls.append(total)

        def update(self, n: int) -> None:
            calls.append(n)

        def set_postfix(self, *, refresh: bool, **figures: str) -> None:
            calls.append(figures["solved"])

        def close(self) -> None:
            calls.append("closed")

    make_trainer(updates_per_iteration=30, progress=Bar).train()
    assert calls[0] == 60
    assert calls.count(1) == 60
    assert calls[31] == calls[-2] == "1/1"
    assert calls[-1] == "closed"


@pytest.mark.parametrize("name", ["iterations", "searches_per_iteration", "updates_per_iteration"])
def test_the_trainer_refuses_to_do_nothing(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        make_trainer(**{name: 0})


def test_a_guided_planner_follows_its_network() -> None:
    net = two_heads()
    with torch.no_grad():
        net.module.table.weight[:, :2] = torch.tensor([-5.0, 5.0])  # to the right
        net.module.table.weight[:, 2] = torch.arange(16.0) - 8.0  # where the reward is
    planner = make_guided_planner(ChainEnv(length=9), net)
    assert planner(ChainEnv(length=9).reset())["num_simulations"].item() == 8

"""The loss, the networks and the trainer of a manager that learns from its searches."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from small_trainers import Bars, weights
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
    make_guided_planner,
)
from torchrl_hmcts.trainers.experiments.waterworld.maze_network import (
    MazeNetwork,
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
    for coeff in (2.0, 0.5, 0.0):
        net = given(LOGITS, [0.8, 0.4])
        loss = ExpertIterationLoss(net, value_loss=name, value_coeff=coeff, reduction="none")
        out = loss(examples())
        torch.testing.assert_close(out["loss_value"], coeff * torch.tensor(expected).double())
        torch.testing.assert_close(out["value_error"], torch.tensor([0.2, 0.1]).double())


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


# --------------------------------------------------------------------------- one call for two heads


def test_a_policy_value_evaluator_grows_the_tree_of_two_separate_evaluators() -> None:
    env, net = ChainEnv(length=7), two_heads()
    kwargs = {"tree_policy": PUCT(c=1.0), "expand": "one"}
    joint = MCTSPlanner(env, leaf_evaluator=PolicyValueEvaluator(net), **kwargs)
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
    guide, waves = PolicyValueEvaluator(net), []
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


def test_gradients_of_distances_flow_along_the_shortest_paths() -> None:
    generator = torch.Generator().manual_seed(3)
    costs = torch.rand(2, 8, 3, 4, generator=generator, dtype=torch.float64) + 0.1
    start = torch.full((2, 3, 4), 99.0, dtype=torch.float64)
    start[0, 0, 1], start[1, 2, 3], start[1, 0, 0] = 0.2, 0.0, 0.4
    costs.requires_grad_()
    start.requires_grad_()
    assert torch.autograd.gradcheck(shortest_distances, (costs, start), eps=1e-7)


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


# ------------------------------------------------------------------------------------- the trainer


def make_trainer(**kwargs: object) -> ExpertIterationTrainer:
    torch.manual_seed(0)
    env = ChainEnv(length=8)
    settings = {"iterations": 2, "searches_per_iteration": 1, "updates_per_iteration": 60}
    return ExpertIterationTrainer(
        env, two_heads(), MCTSPlanner(env), **{"lr": 0.1, **settings, **kwargs}
    )


def test_a_search_needs_no_detour_after_it_learned_from_one() -> None:
    bars = Bars()
    trainer = make_trainer(progress=bars)
    trainer.train()
    first, second = trainer.collector.simulations
    assert second == 7  # the length of the plan
    assert first > 5 * second
    assert trainer.collector.solved == [1, 1]
    assert trainer.collector.base_steps == [first, second]  # of one base step each
    values = trainer.network(ChainEnv(length=8).reset().reshape(1))["state_value"]
    assert values.item() == pytest.approx(0.99**6, abs=0.06)
    assert trainer.history["policy_accuracy"][-1] == 1.0
    (bar,) = bars  # of updates
    assert (bar.total, bar.moves, bar.closed) == (120, [1] * 120, True)
    assert bar.figures["solved"] == "1/1"


def test_a_run_repeats_with_its_seed_and_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
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
    assert torch.equal(weights(second), weights(whole))
    assert make_trainer().load(tmp_path).collected_frames == second.collected_frames > 0


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

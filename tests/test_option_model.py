"""OptionModel and OptionModelLoss: what they predict and what they learn from."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_hmcts.modules import OptionModel, SkillMLP
from torchrl_hmcts.objectives import OptionModelLoss

PARTS = ["loss_delta", "loss_reward", "loss_duration", "loss_terminated"]


class Table(nn.Module):
    """Says the same for every state: a row of numbers for each option."""

    def __init__(self, out_features: int) -> None:
        super().__init__()
        self.rows = nn.Parameter(torch.zeros(2, out_features))

    def forward(self, option: torch.Tensor) -> torch.Tensor:
        return self.rows[option]


def make_table(num_models: int = 1, **kwargs: Any) -> OptionModel:
    return OptionModel(
        Table, ["option"], {"position": 2}, max_duration=9, num_models=num_models, **kwargs
    )


def set_row(model: OptionModel, member: int, option: int, row: list[float]) -> None:
    with torch.no_grad():
        model.network_params["rows"][member, option] = torch.tensor(row)


def make_net(num_models: int = 3, **kwargs: Any) -> OptionModel:
    torch.manual_seed(0)
    return OptionModel(
        lambda n: SkillMLP(2, n, num_skills=2, hidden=(8,), activation=nn.Tanh),
        ["position", "option"],
        {"position": 2},
        max_duration=9,
        num_models=num_models,
        **kwargs,
    )


def make_data(n: int = 6) -> TensorDict:
    g = torch.Generator().manual_seed(0)
    after = TensorDict(
        position=torch.randn(n, 2, generator=g),
        reward=torch.randn(n, 1, generator=g),
        duration=torch.randint(1, 10, (n, 1), generator=g),
        terminated=torch.arange(n).unsqueeze(-1) % 3 == 0,
        batch_size=[n],
    )
    return TensorDict(
        position=torch.randn(n, 2, generator=g),
        option=torch.randint(2, (n,), generator=g),
        next=after,
        batch_size=[n],
    )


def test_a_prediction_is_the_state_plus_the_denormalised_change() -> None:
    model = make_table()
    set_row(model, 0, 1, [1.0, -2.0, 3.0, 0.5, math.log(3.0)])
    model.output_mean.copy_(torch.tensor([0.1, 0.2, 0.5, 4.0]))
    model.output_scale.copy_(torch.tensor([2.0, 1.0, 0.1, 2.0]))
    td = TensorDict(position=torch.tensor([[1.0, 1.0]]), option=torch.tensor([1]), batch_size=[1])
    after = model(td)["next"]
    torch.testing.assert_close(after["position"], torch.tensor([[3.1, -0.8]]))
    torch.testing.assert_close(after["reward"], torch.tensor([[0.8]]))
    torch.testing.assert_close(after["duration"], torch.tensor([[5.0]]))
    torch.testing.assert_close(after["terminated_probability"], torch.tensor([[0.75]]))
    assert after["terminated"].tolist() == [[True]]
    assert after["disagreement"].tolist() == [[0.0]]


def test_an_ensemble_predicts_its_mean_and_says_how_far_it_disagrees() -> None:
    model = make_table(num_models=2)
    set_row(model, 0, 0, [1.0, 3.0, 0.0, 0.0, 0.0])
    set_row(model, 1, 0, [3.0, 3.0, 2.0, 0.0, math.log(3.0)])
    td = TensorDict(position=torch.zeros(1, 2), option=torch.zeros(1).long(), batch_size=[1])
    after = model(td)["next"]
    assert after["position"].tolist() == [[2.0, 3.0]]
    assert after["reward"].tolist() == [[1.0]]
    torch.testing.assert_close(after["terminated_probability"], torch.tensor([[0.625]]))
    # Standard deviations 1 and 0 of the two numbers: sqrt((1 + 0) / 2).
    torch.testing.assert_close(after["disagreement"], torch.tensor([[0.5**0.5]]))


def test_durations_stay_between_one_and_the_longest() -> None:
    model = make_table()
    set_row(model, 0, 0, [0.0, 0.0, 0.0, -50.0, 0.0])
    set_row(model, 0, 1, [0.0, 0.0, 0.0, 50.0, 0.0])
    td = TensorDict(position=torch.zeros(2, 2), option=torch.tensor([0, 1]), batch_size=[2])
    assert model(td)["next", "duration"].tolist() == [[1.0], [9.0]]


def test_normalised_targets_have_mean_zero_and_deviation_one() -> None:
    model, td = make_net(), make_data(50)
    model.fit_normalization(td)
    values = model.targets(td)[:, :-1]
    torch.testing.assert_close(values.mean(0), torch.zeros(4), atol=1e-5, rtol=0.0)
    torch.testing.assert_close(values.std(0), torch.ones(4))


def test_a_duration_that_never_varies_is_predicted_without_learning() -> None:
    model, td = make_table(), make_data()
    td["next", "duration"] = torch.full((6, 1), 7)
    model.fit_normalization(td)
    assert model(td.select("position", "option"))["next", "duration"].unique().item() == 7.0


def test_members_run_together_as_they_would_alone() -> None:
    networks: list[nn.Module] = []

    def make(n: int) -> nn.Module:
        networks.append(SkillMLP(2, n, num_skills=2, hidden=(8,)))
        return networks[-1]

    model = OptionModel(make, ["position", "option"], {"position": 2}, max_duration=9, num_models=3)
    td = make_data().reshape(2, 3)
    alone = torch.stack([network(td["position"], td["option"]) for network in networks])
    torch.testing.assert_close(model.outputs(td), alone)


def test_a_member_alone_predicts_what_it_predicts_among_the_others() -> None:
    model, td = make_net(3), make_data()
    expected = model.outputs(td)
    for index in range(3):
        torch.testing.assert_close(model.member(index).outputs(td)[0], expected[index])
    with pytest.raises(IndexError):
        model.member(3)


def test_features_are_computed_before_the_networks_and_left_out_of_the_data() -> None:
    double = TensorDictModule(lambda x: 2.0 * x, ["position"], ["features"])
    model = OptionModel(
        lambda n: SkillMLP(2, n, num_skills=2),
        ["features", "option"],
        {"position": 2},
        max_duration=9,
        features=double,
    )
    td = make_data()
    network = model.outputs(td)
    assert "features" not in td.keys()
    assert set(model.in_keys) == {"position", "option"}
    td["position"] *= 0.5
    model.features = None
    model.network_keys = ["position", "option"]
    td["position"] *= 4.0
    torch.testing.assert_close(model.outputs(td), network)


def test_bad_models_are_refused_with_their_value() -> None:
    shared = Table(5)
    with pytest.raises(ValueError, match="builds a new one"):
        OptionModel(lambda n: shared, ["option"], {"position": 2}, max_duration=3, num_models=2)
    widths = iter([4, 5])
    with pytest.raises(ValueError, match="alike"):
        OptionModel(
            lambda n: nn.Linear(next(widths), n),
            ["position"],
            {"position": 2},
            max_duration=3,
            num_models=2,
        )
    narrow = OptionModel(lambda n: Table(n - 1), ["option"], {"position": 2}, max_duration=3)
    with pytest.raises(ValueError, match="out_features"):
        narrow(make_data())
    with pytest.raises(ValueError, match="at least 2 transitions; got 1"):
        make_table().fit_normalization(make_data(1))


def test_each_part_of_the_loss_is_the_closed_form_of_its_error() -> None:
    model = make_table()
    set_row(model, 0, 0, [0.5, 3.0, 2.0, 4.0, math.log(3.0)])
    td = make_data(1)
    td["option"].zero_()
    td["next"].update(
        {
            "position": td["position"].clone(),  # no change
            "reward": torch.tensor([[1.0]]),
            "duration": torch.tensor([[2]]),
            "terminated": torch.tensor([[True]]),
        }
    )
    out = OptionModelLoss(model)(td)
    # Huber with a bend at 1: 0.5^2 / 2 and 3 - 1/2, averaged over the two numbers.
    torch.testing.assert_close(out["loss_delta"], torch.tensor((0.125 + 2.5) / 2.0))
    torch.testing.assert_close(out["loss_reward"], torch.tensor(1.0))
    torch.testing.assert_close(out["loss_duration"], torch.tensor(1.5))
    torch.testing.assert_close(out["loss_terminated"], torch.tensor(-math.log(0.75)))
    torch.testing.assert_close(out["delta_error"], torch.tensor(1.75))
    assert out["terminated_accuracy"].item() == 1.0


@pytest.mark.parametrize("name", ["reward", "duration"])
def test_only_the_state_of_a_terminal_step_may_be_empty(name: str) -> None:
    data = make_data()
    data["next", "duration"] = data["next", "duration"].float()
    data["next", "position"][0] = torch.nan  # step 0 is a terminal one
    assert all(OptionModelLoss(make_net())(data)[part].isfinite() for part in PARTS)
    data["next", name][0] = torch.nan
    assert OptionModelLoss(make_net())(data)[f"loss_{name}"].isnan()


def test_the_reward_of_a_terminal_step_counts_in_the_normalisation() -> None:
    data = make_data(4)  # steps 0 and 3 are terminal
    data["next", "position"][[0, 3]] = torch.nan
    data["next", "reward"] = torch.tensor([[1.0], [0.0], [0.0], [1.0]])
    model = make_table().fit_normalization(data)
    assert model.output_mean[2] == 0.5
    assert model.output_scale[2].item() == pytest.approx(math.sqrt(1 / 3))


def test_a_mask_decides_which_members_learn_from_a_transition() -> None:
    model, td = make_net(2), make_data(4)
    td["bootstrap_mask"] = torch.tensor([[1.0, 0.0]]).expand(4, 2)
    loss = OptionModelLoss(model)
    total = sum(value for key, value in loss(td).items() if key.startswith("loss"))
    total.backward()
    for parameter in model.network_params.parameters():
        assert parameter.grad[0].abs().sum() > 0
        assert not parameter.grad[1].any()


def test_the_mean_over_members_is_the_mean_of_their_losses() -> None:
    td = make_data()
    both = make_net(2)
    expected = OptionModelLoss(both)(td)
    alone = []
    for member in range(2):
        td["bootstrap_mask"] = torch.eye(2)[member].expand(6, 2)
        alone.append(OptionModelLoss(both)(td))
    for key in PARTS:
        torch.testing.assert_close(alone[0][key] + alone[1][key], expected[key])


def test_weights_scale_their_part_only() -> None:
    td, model = make_data(), make_net()
    plain = OptionModelLoss(model)(td)
    names = [name.replace("loss_", "") + "_coeff" for name in PARTS]
    for i, name in enumerate(names):
        scaled = OptionModelLoss(model, **{name: 3.0})(td)
        for j, key in enumerate(PARTS):
            torch.testing.assert_close(scaled[key], plain[key] * (3.0 if i == j else 1.0))


def test_training_recovers_a_known_outcome() -> None:
    td = make_data(64)
    right = td["option"] == 1
    td["next", "position"] = td["position"] + torch.where(right, 1.0, -0.5).unsqueeze(-1)
    td["next", "reward"] = right.to(torch.float32).unsqueeze(-1)
    td["next", "duration"] = torch.where(right, 4, 8).unsqueeze(-1)
    td["next", "terminated"] = right.unsqueeze(-1)
    model = make_table(num_models=2).fit_normalization(td)
    loss = OptionModelLoss(model)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.1)
    for _ in range(200):
        total = sum(value for key, value in loss(td).items() if key.startswith("loss"))
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    after = model.predict(td)
    torch.testing.assert_close(after["position"], td["next", "position"], atol=1e-2, rtol=0.0)
    torch.testing.assert_close(after["reward"], td["next", "reward"], atol=1e-2, rtol=0.0)
    assert torch.equal(after["duration"].round().long(), td["next", "duration"])
    assert torch.equal(after["terminated"], td["next", "terminated"])

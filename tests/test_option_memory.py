"""OptionMemory: what was met goes before what is predicted."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_hmcts.modules import OptionMemory, OptionModel


class Nothing(nn.Module):
    """Predicts that nothing changes."""

    def __init__(self, out_features: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(out_features))

    def forward(self, option: torch.Tensor) -> torch.Tensor:
        return self.bias.expand(*option.shape, -1)


def make_memory(radius: float = 0.5, **kwargs: int) -> OptionMemory:
    model = OptionModel(Nothing, ["option"], {"place": 2}, max_duration=9)
    model.output_mean[-1] = 9.0
    kwargs.setdefault("num_contexts", 3)
    return OptionMemory(model, ["place"], radius, context_key="maze", **kwargs)


def state(x: float, option: int, maze: int = 0) -> TensorDict:
    return TensorDict(
        place=torch.tensor([[x, 0.0]]),
        option=torch.tensor([option]),
        maze=torch.tensor([maze]),
        batch_size=[1],
    )


def moved(td: TensorDict, dx: float, *, steps: int = 4, end: bool = False) -> TensorDict:
    after = TensorDict(
        place=td["place"] + torch.tensor([dx, 0.0]),
        reward=torch.tensor([[0.7 if end else 0.0]]),
        duration=torch.tensor([[steps]]),
        terminated=torch.tensor([[end]]),
        batch_size=[1],
    )
    return td.clone().set("next", after)


def recalled(memory: OptionMemory, td: TensorDict) -> TensorDict:
    return memory.recall(td, memory.model.predict(td))


def test_the_nearest_outcome_of_the_same_option_replaces_the_prediction() -> None:
    memory = make_memory()
    memory.remember(moved(state(1.0, option=0), 2.0, end=True))
    memory.remember(moved(state(1.4, option=0), -1.0))
    memory.remember(moved(state(1.0, option=1), 5.0))
    after = recalled(memory, state(1.1, option=0))
    torch.testing.assert_close(after["place"], torch.tensor([[3.1, 0.0]]))  # moved by as much
    torch.testing.assert_close(after["reward"], torch.tensor([[0.7]]))
    assert after["duration"].item() == 4.0
    assert after["terminated"].item()
    assert after["terminated_probability"].item() == 1.0
    torch.testing.assert_close(
        recalled(memory, state(1.3, option=0))["place"], torch.tensor([[0.3, 0.0]])
    )


@pytest.mark.parametrize(("x", "option", "maze"), [(1.6, 0, 0), (1.0, 1, 0), (1.0, 0, 1)])
def test_other_places_options_and_contexts_are_predicted(x: float, option: int, maze: int) -> None:
    memory = make_memory()
    memory.remember(moved(state(1.0, option=0), 2.0))
    td = state(x, option, maze)
    assert torch.equal(recalled(memory, td)["place"], td["place"])


def test_any_batch_shape_is_recalled_and_predictions_are_left_as_they_were() -> None:
    memory = make_memory()
    memory.remember(moved(state(1.0, option=0), 2.0))
    td = torch.cat([state(x, 0) for x in (0.0, 1.0, 2.0, 1.2)]).reshape(2, 2)
    predicted = memory.model.predict(td)
    before = predicted.clone()
    after = memory.recall(td, predicted)
    torch.testing.assert_close(after["place"][..., 0], torch.tensor([[0.0, 3.0], [2.0, 3.2]]))
    assert (predicted == before).all()


def test_padding_is_not_remembered() -> None:
    memory = make_memory()
    memory.remember(moved(state(1.0, option=0), 2.0).set("_step", torch.tensor([False])))
    assert recalled(memory, state(1.0, option=0))["place"][0, 0].item() == 1.0


def test_the_oldest_outcome_makes_room_and_clear_forgets_all() -> None:
    memory = make_memory(capacity=2)
    for x in (1.0, 3.0, 5.0):
        memory.remember(moved(state(x, option=0), 1.0))
    places = [recalled(memory, state(x, option=0))["place"][0, 0].item() for x in (1.0, 3.0, 5.0)]
    assert places == [1.0, 4.0, 6.0]
    memory.clear()
    assert recalled(memory, state(5.0, option=0))["place"][0, 0].item() == 5.0

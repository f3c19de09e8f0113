"""What actions control, on a console of three bytes whose rules are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Categorical, Composite, Unbounded, UnboundedDiscrete
from torchrl.envs import EnvBase

from torchrl_hmcts.trainers.skills.controllability import probe_controllability


class Console(EnvBase):
    """Bytes: 0 moved by the actions 1 (up 2) and 2 (down 3); 1 moves by itself; 2 stands still;
    3 is set off by action 1 alone."""

    batch_locked = False

    def __init__(self) -> None:
        super().__init__()
        ram = UnboundedDiscrete((4,), dtype=torch.uint8)
        self.observation_spec = Composite(ram=ram)
        self.state_spec = Composite(ram=ram.clone())
        self.action_spec = Categorical(3)
        self.reward_spec = Unbounded((1,))
        self.done_spec = Binary(1, dtype=torch.bool)

    def _reset(self, tensordict=None, **kwargs):
        shape = () if tensordict is None else tensordict.batch_size
        return TensorDict({"ram": torch.zeros(*shape, 4, dtype=torch.uint8)}, shape)

    def _step(self, tensordict):
        ram, action = tensordict["ram"].clone(), tensordict["action"]
        ram[..., 0] += (2 * (action == 1) - 3 * (action == 2)).to(torch.uint8)
        ram[..., 1] += 7
        ram[..., 3] += 5 * (action == 1).to(torch.uint8)
        shape = tensordict.batch_size
        done = torch.zeros(*shape, 1, dtype=torch.bool)
        return TensorDict({"ram": ram, "reward": torch.zeros(*shape, 1), "done": done}, shape)

    def _set_seed(self, seed):
        return None


def states(count: int = 64) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    ram = torch.randint(256, (count, 4), generator=generator, dtype=torch.uint8)
    return TensorDict({"ram": ram}, [count])


def test_effects_are_measured_against_the_neutral_action_and_bytes_wrap_around() -> None:
    found = probe_controllability(Console(), states(), "ram")
    np.testing.assert_array_equal(found.effects, [[0, 0, 0, 0], [2, 0, 0, 5], [-3, 0, 0, 0]])
    np.testing.assert_array_equal(found.dependence, [1, 0, 0, 1])
    np.testing.assert_array_equal(found.motion, [0, 1, 0, 0])
    # Control needs an action that raises and one that lowers.
    assert found.controllable.tolist() == [0]
    assert found.moving.tolist() == [1]
    assert found.raising(0).tolist() == [1]
    assert found.lowering(0).tolist() == [2]
    assert found.lowering(3).tolist() == []


def test_features_of_few_values_are_left_out() -> None:
    found = probe_controllability(Console(), states(), "ram", min_values=257)
    assert found.controllable.tolist() == found.moving.tolist() == []


def test_what_cannot_be_probed_is_refused() -> None:
    with pytest.raises(ValueError, match="from 0 to 2; got 3"):
        probe_controllability(Console(), states(), "ram", neutral=3)
    with pytest.raises(ValueError, match="in states; got none"):
        probe_controllability(Console(), states(0), "ram")

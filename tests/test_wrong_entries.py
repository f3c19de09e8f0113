"""A sentence, instead of an error of PyTorch's, where an entry is missing or has another form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Categorical

from torchrl_hmcts.modules import (
    ConcatSkillMLP,
    SkillActor,
    SkillDiscriminator,
    SkillMLP,
    SkillPolicy,
)
from torchrl_hmcts.objectives import SkillDiscriminatorLoss
from torchrl_hmcts.transforms import SkillReward


def transitions(skill: torch.Tensor | None) -> TensorDict:
    td = TensorDict(velocity=torch.zeros(5, 2), next=TensorDict(displacement=torch.zeros(5, 2)))
    if skill is not None:
        td.set("skill", skill)
    return td.auto_batch_size_(1)


def actor(**kwargs: object) -> SkillActor:
    return SkillActor(2, Categorical(4), num_skills=4, in_keys=["velocity"], **kwargs)


def discriminator() -> SkillDiscriminator:
    return SkillDiscriminator(2, num_skills=4)


READERS: dict[str, Callable[[], Callable[[TensorDictBase], object]]] = {
    "SkillPolicy": lambda: SkillPolicy(actor()),
    "SkillNetwork": lambda: actor(),
    "SkillDiscriminatorLoss": lambda: SkillDiscriminatorLoss(discriminator()),
    "SkillDiscriminatorLoss as reward": lambda: SkillReward(
        SkillDiscriminatorLoss(discriminator())
    ),
}


@pytest.mark.parametrize("name", READERS)
def test_a_skill_that_is_missing_is_named_with_what_writes_it(name: str) -> None:
    message = rf"{name.split()[0]} reads \W*skill\W*, which is missing.*SkillTransform"
    with pytest.raises(KeyError, match=message):
        READERS[name]()(transitions(None))


@pytest.mark.parametrize("network", [SkillMLP, ConcatSkillMLP])
@pytest.mark.parametrize("skill", [-1, 3])
def test_a_skill_that_does_not_exist_is_named(network: Any, skill: int) -> None:
    run = network(2, 1, num_skills=3)
    message = f"Skill {skill} does not exist: a network of num_skills=3 knows 0 to 2"
    with pytest.raises(ValueError, match=message):
        run(torch.zeros(2, 2), torch.tensor([0, skill]))


def test_a_feature_that_is_missing_is_named_with_what_there_is() -> None:
    td = transitions(torch.zeros(5, dtype=torch.int64)).exclude("velocity")
    with pytest.raises(
        KeyError, match=r"SkillPolicy reads \W*velocity\W*, which is missing.*\Wskill\W"
    ):
        SkillPolicy(actor())(td)


@pytest.mark.parametrize("network", [{}, {"network": ConcatSkillMLP}], ids=["heads", "concat"])
@pytest.mark.parametrize(
    ("skill", "got"),
    [
        (torch.zeros(5), r"torch.float32 \[5\]"),
        (torch.zeros(5, 1, dtype=torch.int64), r"torch.int64 \[5, 1\]"),
        (torch.zeros(5, 4, dtype=torch.bool), r"torch.bool \[5, 4\]"),
    ],
)
def test_a_skill_of_another_form_is_refused(
    skill: torch.Tensor, got: str, network: dict[str, type]
) -> None:
    with pytest.raises(ValueError, match=rf"indices, int64 \[5\].*got {got}.*argmax"):
        SkillPolicy(actor(**network))(transitions(skill))

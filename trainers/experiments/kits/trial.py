"""The skills that were learned, and how the agent did with them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import LossModule

from torchrl_hmcts.planners import MCTSPlanner
from torchrl_hmcts.trainers.evaluation import Results
from torchrl_hmcts.trainers.skills.rounds import RoundRecords


@dataclass
class LearnedSkills:
    """A worker and how it became what it is.

    Attributes:
        worker (TensorDictModule): with its most probable actions.
        loss (LossModule, optional): with its networks; None where nothing was learned.
        history (mapping): all logged curves.
        tests (RoundRecords): what it achieved while it learned.
        steps (int): base steps of training, simulated ones included.
        worker_step (int): those that the networks have seen that are kept.
        rounds (int): of Algorithm 3.
        seconds (float): of the processor, tests included.
    """

    worker: TensorDictModuleBase
    loss: LossModule | None
    history: Mapping[str, list[float]]
    tests: RoundRecords
    steps: int
    worker_step: int
    rounds: int
    seconds: float


@dataclass
class Trial:
    """One episode from each start: a plan, executed in another instance of the env.

    Attributes:
        starts (TensorDict): states ``[M]``.
        planner (MCTSPlanner): with which the plans were made.
        results (Results): what they led to.
        second_searches (int): starts that were searched twice.
        compile_seconds (float): until the first plan of all was made.
        cpu_seconds (float): of all searches and episodes.
    """

    starts: TensorDictBase
    planner: MCTSPlanner
    results: Results
    second_searches: int
    compile_seconds: float
    cpu_seconds: float

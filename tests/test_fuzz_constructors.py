"""Every public constructor, given what makes no sense: it refuses by name, or it works.

A case replaces one to three arguments of a valid call. It may be accepted, or end in a ValueError
or TypeError that has the argument's name or its value; never in another error, in a NaN that is
accepted, or in no end.
"""

from __future__ import annotations

import importlib
import inspect
import math
import os
import re
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, OneHot
from torchrl.modules import UCBScore
from torchrl.trainers import Trainer

from torchrl_hmcts import envs, modules, objectives, planners, trainers, transforms
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers.experiments.lab.config import LabMazeConfig
from torchrl_hmcts.trainers.experiments.waterworld.config import (
    WaterworldA3CConfig,
    WaterworldGoalsConfig,
)
from torchrl_hmcts.trainers.experiments.waterworld.worker import make_training_env

pytestmark = pytest.mark.filterwarnings("ignore")  # torch may warn of what it then accepts
Good = Callable[[], tuple[Callable[..., Any], dict[str, Any]]]
IN, SPEC = ("velocity",), OneHot(4)
CASES: Counter[str] = Counter()


@cache
def chain() -> Any:
    return ChainEnv(length=4)


@cache
def planner() -> Any:
    return planners.MCTSPlanner(chain())


@cache
def maze() -> torch.Tensor:
    return envs.maze_pool("train")[:1]


def linear(inputs: int, outputs: int, *keys: str) -> TensorDictModule:
    return TensorDictModule(nn.Linear(inputs, outputs), [keys[0]], [keys[1]])


@cache
def skill_loss() -> Any:
    return trainers.DIAYNTrainer.make_loss(training_env(), 4, hidden=(4,), seed=0)


@cache
def training_env() -> Any:
    return make_training_env(copies=1)


def actor() -> Any:
    return modules.SkillActor(2, SPEC, 4, in_keys=IN, hidden=(4,))


def gaussian_actor() -> Any:
    return modules.GaussianSkillActor(2, Bounded(-1, 1, (2,)), 4, in_keys=IN, hidden=(4,))


def critic() -> Any:
    return modules.SkillCritic(2, 4, 4, in_keys=IN, hidden=(4,))


def discriminator() -> Any:
    return modules.SkillDiscriminator(2, 4)


def option_model(**kwargs: Any) -> Any:
    settings = {"max_duration": 5, "num_models": 1, **kwargs}
    make = partial(nn.Linear, 3)
    return modules.OptionModel(lambda n: make(n), ["state"], {"state": 1}, **settings)


def of(name: str, cls: Callable[..., Any], **good: Any) -> tuple[str, Good]:
    """An entry of the table: values that are functions without name are made anew for each case."""

    def make() -> tuple[Callable[..., Any], dict[str, Any]]:
        made = {k: v() if getattr(v, "__name__", "") == "<lambda>" else v for k, v in good.items()}
        return cls, made

    return name, make


def everything(package: Any, **table: dict[str, Any]) -> dict[str, Good]:
    return dict(of(name, getattr(package, name), **good) for name, good in table.items())


NET = {"in_keys": IN, "hidden": (4,)}
LOSS = {"actor_network": lambda: actor(), "qvalue_network": lambda: critic()}
GOOD: dict[str, Good] = {
    **everything(
        planners,
        PUCT={},
        UCT={},
        BestPlan={},
        MaxBackup={},
        MeanBackup={},
        MostVisited={},
        DirichletNoise={},
        Gumbel={},
        HighestValue={},
        SampledVisits={},
        ProgressiveWidening={},
        SearchBudget={},
        TreeRollout={},
        RadiusNovelty={"key": "position", "radius": 1.0},
        WidthNovelty={"key": "ram"},
        Transpositions={"key": "ram"},
        TorchRLScore={"score_module": lambda: UCBScore(c=1.0)},
        RolloutEvaluator={},
        ValueEvaluator={"module": lambda: linear(2, 1, "velocity", "state_value")},
        ModulePrior={"module": lambda: linear(2, 4, "velocity", "logits"), "logits_key": "logits"},
        MixedEvaluator={
            "first": lambda: planners.RolloutEvaluator(),
            "second": lambda: planners.RolloutEvaluator(),
        },
        PolicyValueEvaluator={
            "module": lambda: TensorDictModule(
                nn.Identity(), ["velocity"], ["logits", "state_value"]
            )
        },
        MCTSPlanner={"env": lambda: chain()},
        HierarchicalPolicy={"planner": lambda: planner()},
        ModelBasedControl={"planner": lambda: planner()},
        GoalPlanner={"planner": lambda: planner(), "to_macro": abs, "goal_key": "state"},
        SearchTree={"num_roots": 2, "num_options": 3},
        Search={
            "num_roots": 2,
            "num_options": 3,
            "tree_policy": lambda: planners.UCT(),
            "backup": lambda: planners.MaxBackup(),
        },
    ),
    **everything(
        modules,
        FixedSkillPrior={"num_skills": 4},
        LearnedSkillPrior={"num_skills": 4},
        GrowingSkillPrior={"num_skills": 4},
        ConcatSkillMLP={"in_features": 2, "out_features": 3, "num_skills": 4, "hidden": (4,)},
        SkillMLP={"in_features": 2, "out_features": 3, "num_skills": 4, "hidden": (4,)},
        SkillNetwork={"network": lambda: nn.Linear(2, 2), "in_keys": IN, "out_key": "out"},
        SkillActor={"in_features": 2, "action_spec": SPEC, "num_skills": 4, **NET},
        GaussianSkillActor={
            "in_features": 2,
            "action_spec": Bounded(-1, 1, (2,)),
            "num_skills": 4,
            **NET,
        },
        SkillCritic={"in_features": 2, "num_actions": 4, "num_skills": 4, **NET},
        SkillActionCritic={"in_features": 2, "action_features": 2, "num_skills": 4, **NET},
        SkillDiscriminator={"in_features": 2, "num_skills": 4},
        SkillDynamics={"in_features": 2, "target_features": 2, "num_skills": 4, "hidden": (4,)},
        SkillEncoder={"in_features": 2, "num_skills": 4, "hidden": (4,)},
        SpectralLinear={"in_features": 2, "out_features": 3},
        SkillPolicy={"actor": lambda: actor()},
        StallTermination={"num_steps": 3},
        TerminationNetwork={"in_features": 2, "num_options": 4, **NET},
        LearnedTermination={
            "network": lambda: modules.TerminationNetwork(2, 4, in_keys=IN, hidden=(4,))
        },
        OptionModel={
            "make_network": nn.LazyLinear,
            "in_keys": ["state"],
            "delta_keys": {"state": 1},
            "max_duration": 5,
        },
        OptionMemory={
            "model": lambda: option_model(),
            "keys": ["state"],
            "radius": 1.0,
            "num_contexts": 2,
            "context_key": "maze_index",
        },
    ),
    **everything(
        objectives,
        DIAYNLoss={**LOSS, "discriminator": lambda: discriminator(), "action_space": SPEC},
        DiscreteSkillSACLoss={
            **LOSS,
            "objective": lambda: objectives.SkillDiscriminatorLoss(discriminator()),
            "action_space": SPEC,
        },
        SkillSACLoss={
            "actor_network": lambda: gaussian_actor(),
            "qvalue_network": lambda: modules.SkillActionCritic(2, 2, 4, in_keys=IN, hidden=(4,)),
            "objective": lambda: objectives.SkillDiscriminatorLoss(discriminator()),
            "action_spec": Bounded(-1, 1, (2,)),
        },
        SkillDiscriminatorLoss={"discriminator": lambda: discriminator()},
        METRAEncoderLoss={"encoder": lambda: modules.SkillEncoder(2, 4, hidden=(4,))},
        LSDEncoderLoss={
            "encoder": lambda: modules.SkillEncoder(
                2, 4, hidden=(4,), linear=modules.SpectralLinear
            )
        },
        SkillDynamicsLoss={"dynamics": lambda: modules.SkillDynamics(2, 2, 4, hidden=(4,))},
        SkillPriorLoss={"prior": lambda: modules.LearnedSkillPrior(4)},
        OptionModelLoss={"model": lambda: option_model()},
        ExpertIterationLoss={"network": lambda: linear(2, 4, "velocity", "logits")},
        OptionTerminationLoss={
            "termination_network": lambda: modules.TerminationNetwork(2, 4, in_keys=IN, hidden=(4,))
        },
        IntraOptionQLoss={"qvalue_network": lambda: critic()},
        A3CLoss={
            "actor_network": lambda: actor(),
            "critic_network": lambda: linear(2, 1, "velocity", "state_value"),
        },
    ),
    **everything(
        transforms,
        DisplacementTransform={},
        StallTransform={},
        OptionRecorder={"keys": ["velocity"]},
        OptionTransform={
            "worker": lambda: linear(2, 1, "velocity", "action"),
            "num_options": 4,
            "max_steps": 5,
        },
        DIAYNReward={"discriminator": lambda: discriminator(), "num_skills": 4},
        SkillReward={"objective": lambda: objectives.SkillDiscriminatorLoss(discriminator())},
        SkillMaskTransform={"prior": lambda: modules.GrowingSkillPrior(4)},
        SkillTransform={"num_skills": 4},
        SubgoalTransform={"planner": abs},
    ),
    **everything(
        envs,
        GridworldMazeEnv={},
        WaterworldMazeEnv={},
        LabMazeEnv={"maze_seeds": range(2)},
        RepeatActions={"actions": 3},
        SharedMLP={"num_options": 2, "num_actions": 3, "hidden": (4,)},
    ),
    **everything(
        trainers,
        SearchGuide={"num_options": 3, "hidden": (4,), "buffer_size": 8},
        OptionGoals={"goals": [0, 2]},
        AtariSearch={},
        GoalSearch={},
        DemoConfig={},
        TerminationConfig={},
        StateCoverage={},
        ScriptedExpert={},
        SharedAdam={"params": lambda: [nn.Parameter(torch.zeros(2))]},
        SharedRMSprop={"params": lambda: [nn.Parameter(torch.zeros(2))]},
        GrowSkills={"prior": lambda: modules.GrowingSkillPrior(4), "coverage": float},
        MazeView={"mazes": lambda: maze()},
        MazeNetwork={"mazes": lambda: maze(), "channels": 2, "hidden": 2},
        DIAYNTrainer={
            "env": lambda: make_training_env(copies=1),
            "loss_module": lambda: skill_loss(),
        },
        HMCTSTrainer={
            "make_env": partial(envs.WaterworldMazeEnv, observation=False),
            "loss_module": lambda: skill_loss(),
        },
        A3CTrainer={
            "make_env": ChainEnv,
            "loss_module": lambda: objectives.A3CLoss(
                actor(), linear(2, 1, "velocity", "state_value")
            ),
            "total_frames": 100,
            "num_learners": 0,
        },
        ExpertIterationTrainer={
            "env": lambda: chain(),
            "network": lambda: TensorDictModule(
                nn.Linear(1, 3), ["state"], ["logits", "state_value"]
            ),
            "first_planner": lambda: planner(),
        },
    ),
    **dict(
        [
            of("LabMazeConfig", LabMazeConfig),
            of("WaterworldA3CConfig", WaterworldA3CConfig),
            of("WaterworldGoalsConfig", WaterworldGoalsConfig),
        ]
    ),
}
COSTLY = {  # milliseconds each; the others take microseconds
    *("DIAYNTrainer", "HMCTSTrainer", "A3CTrainer", "ExpertIterationTrainer", "MCTSPlanner"),
    *("WaterworldMazeEnv", "LabMazeEnv", "GridworldMazeEnv", "MazeNetwork", "MazeView"),
    *("DIAYNLoss", "DiscreteSkillSACLoss", "SkillSACLoss", "A3CLoss", "OptionModel"),
    *("IntraOptionQLoss", "OptionTerminationLoss", "ExpertIterationLoss", "SkillDynamicsLoss"),
}
EXCLUDED = {  # public names that are not fuzzed here, and why
    **dict.fromkeys(
        ["NodeStatistics", "Plan", "TreeView", "Root", "SearchProgress", "Transition"],
        "a record that the search fills",
    ),
    **dict.fromkeys(["GoalEpisodes", "GoalTrack", "TerminationResult"], "a record of results"),
    **dict.fromkeys(["NoveltyTest", "PlansGoals", "OptionWorker"], "a protocol"),
    **dict.fromkeys(["SkillObjective", "SkillPrior"], "a base class"),
    **dict.fromkeys(
        ["AtariOptionPool", "AtariRAMEnv", "DeepMindLabEnv", "OptionPool"], "starts processes"
    ),
    "SkillWorker": "takes an actor: test_option_pool.py",
    "StatelessSimulator": "takes an env, and has its own tests",
    **dict.fromkeys(
        ["AttributeSnapshot", "ReplaySnapshot", "SettableGymEnv", "Snapshot", "SnapshotError"],
        "takes a Gymnasium env: test_settable_gym.py",
    ),
    "SkillRewardHook": "hands its arguments to SkillReward",
    **dict.fromkeys(
        ["ByteGoal", "FollowGoals", "JoinedWorkers", "OccasionalAction"], "belongs to an Atari game"
    ),
    **dict.fromkeys(
        [
            "AtariAgent",
            "GoalFinder",
            "ActionSetSource",
            "ActionSource",
            "BestSource",
            "RepeatSource",
            "GoalSource",
            "DIAYNSource",
            "DistilledSource",
            "FineTunedSource",
            "RetrainedSource",
        ],
        "plays an Atari game: test_atari_agent.py, test_atari_sources.py",
    ),
    **dict.fromkeys(
        ["AtariProgress", "Candidate", "Options", "Controllability"], "a record of results"
    ),
    **dict.fromkeys(["WorkerSource"], "a protocol"),
    **dict.fromkeys(["ContinuousDIAYNLoss"], "SkillSACLoss with a discriminator"),
    **dict.fromkeys(["NStepReturn"], "the arguments of TorchRL's ValueEstimatorBase"),
    **dict.fromkeys(["OptionModelEnv", "TorchRLGymnasiumEnv"], "reads another env's specs first"),
    **dict.fromkeys(["CollectorError", "FolderInUse", "LearnerError"], "an exception"),
    **dict.fromkeys(["DurableRotation"], "takes a folder: test_fault_checkpoints.py"),
    **dict.fromkeys(["ResumableTrainer"], "the base of the trainers, which are fuzzed"),
    **dict.fromkeys(
        ["GeneratorStates", "RunningEpisodes", "SearchCollector", "SearchCoverage", "TilePlanner"],
        "takes other parts, whose types it checks",
    ),
    **dict.fromkeys(["AnyTermination"], "takes callables only"),
    **dict.fromkeys(["HindsightTransitions"], "takes recorded transitions"),
}

NAN = float("nan")
NASTY: list[Any] = [
    *(None, True, -1, 0, 1, 2, 2**62, -(2**62), 0.0, -0.5, 1.5, 1e300),
    *(NAN, float("inf"), float("-inf"), np.float64("nan"), np.int64(-3), complex(1, 1)),
    *("", "x", "no such thing", b"bytes", (), [], {}, set()),
    *((-1,), (0,), (2.5,), ("a", "b"), [None], {"a": 1}, object(), object, len),
    *(torch.zeros(0), torch.tensor(NAN), torch.ones(2, 2), np.zeros(3), TensorDict(), OneHot(2)),
]


class Hang(BaseException):
    """No end in sight."""


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def ring(*_: Any) -> None:
        raise Hang

    monkeypatch.chdir(tmp_path)  # a save_dir may be made
    before = signal.signal(signal.SIGALRM, ring)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


def shows(value: Any, message: str) -> bool:
    texts = {repr(value), str(value)}
    if isinstance(value, torch.Tensor):
        texts |= {str(list(value.shape)), str(value.shape), str(value.dtype)}
        texts |= {str(value.item())} if value.numel() == 1 else set()
    if isinstance(value, (tuple, list, set, dict)):
        texts |= {repr(item) for item in value}
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        texts |= {f"{value:g}", f"{value:,}"}
    texts.add(type(value).__name__)
    if isinstance(value, (tuple, list, set, dict, str)) and not value:
        texts.add("got none")
    return any(text and text in message for text in texts)


def close(made: Any) -> None:
    if isinstance(made, Trainer):
        made.collector.shutdown()


def is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def complaint(call: Callable[..., Any], good: Mapping[str, Any], bad: Mapping[str, Any]) -> str:
    """Returns what is wrong with how a call takes bad arguments; empty if nothing is."""
    shown = f"{getattr(call, '__name__', call)}({', '.join(f'{k}={v!r}' for k, v in bad.items())})"
    signal.setitimer(signal.ITIMER_REAL, 10.0)
    try:
        made = call(**{**good, **bad})
    except (ValueError, TypeError) as error:
        message = str(error)
        names = any(re.search(rf"\b{re.escape(name.rstrip('s'))}", message) for name in bad)
        if names or any(shows(value, message) for value in bad.values()):
            return ""
        return f"{shown} does not say what: {type(error).__name__}: {message[:200]}"
    except OSError as error:  # a folder that is not there, or cannot be made
        named = any(shows(v, str(error)) or name in str(error) for name, v in bad.items())
        return "" if named else f"{shown}: {error!r}"
    except Hang:
        return f"{shown} takes more than ten seconds"
    except Exception as error:
        vast = any(isinstance(value, int) and value > 2**40 for value in bad.values())
        lack = isinstance(error, MemoryError) or "allocate memory" in str(error)
        if vast and lack:  # the system's error stays what it is
            return ""
        return f"{shown} ends in {type(error).__name__}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    close(made)
    nans = [name for name, value in bad.items() if is_nan(value)]
    return f"{shown} accepts NaN" if nans else ""


def parameters(call: Callable[..., Any]) -> list[str]:
    function = call.__init__ if inspect.isclass(call) else call
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    names = [p.name for p in inspect.signature(function).parameters.values() if p.kind in kinds]
    return [name for name in names if name != "self"]


def fuzz(name: str, cases: int) -> None:
    call, _ = GOOD[name]()
    names = parameters(call)
    if not names:
        return
    arguments = st.dictionaries(
        st.sampled_from(names), st.sampled_from(range(len(NASTY))), min_size=1, max_size=3
    )

    @settings(
        max_examples=cases, suppress_health_check=list(HealthCheck), database=None, deadline=None
    )
    @given(arguments)
    def case(chosen: dict[str, int]) -> None:
        CASES[name] += 1
        _, good = GOOD[name]()
        wrong = complaint(call, good, {key: NASTY[i] for key, i in chosen.items()})
        assert not wrong, wrong

    case()


def test_every_public_constructor_is_fuzzed_or_says_why_not() -> None:
    public = {
        name
        for package in (planners, objectives, modules, transforms, envs, trainers)
        for name in package.__all__
        if inspect.isclass(getattr(package, name))
    }
    assert public - set(GOOD) - set(EXCLUDED) == set()
    assert not set(GOOD) & set(EXCLUDED)


@pytest.mark.parametrize("name", GOOD)
def test_the_valid_call_is_valid(name: str) -> None:
    call, good = GOOD[name]()
    made = call(**good)
    close(made)


@pytest.mark.parametrize("name", GOOD)
def test_what_makes_no_sense_is_refused_by_name(name: str) -> None:
    call, _ = GOOD[name]()
    for parameter in parameters(call)[:3]:  # one by one first: the plainest failure is shown
        for value in NASTY:
            if name in COSTLY and not isinstance(value, float):
                continue
            CASES[name] += 1
            assert not complaint(call, GOOD[name]()[1], {parameter: value})
    fuzz(name, 30 if name in COSTLY else 60)


@pytest.mark.slow
@pytest.mark.parametrize("name", GOOD)
def test_what_makes_no_sense_is_refused_by_name_in_many_more_cases(name: str) -> None:
    fuzz(name, 300 if name in COSTLY else 1500)


def test_the_cases_are_counted() -> None:
    """Runs last; writes the count where TORCHRL_HMCTS_FUZZ_COUNT says."""
    path = os.environ.get("TORCHRL_HMCTS_FUZZ_COUNT")
    if path:
        with open(path, "a") as file:
            file.write(f"constructors {sum(CASES.values())}\n")


def test_the_check_notices_what_it_is_for() -> None:
    def silent(x: Any = 0) -> None:
        return None

    def mute(x: Any = 0) -> None:
        raise ValueError("no")

    def wrong(x: Any = 0) -> None:
        raise KeyError(x)

    def good(x: Any = 0) -> None:
        raise ValueError(f"x must not be {x!r}")

    assert "accepts NaN" in complaint(silent, {}, {"x": NAN})
    assert "does not say what" in complaint(mute, {}, {"x": -1})
    assert "ends in KeyError" in complaint(wrong, {}, {"x": -1})
    assert not complaint(good, {}, {"x": -1})
    assert not complaint(silent, {}, {"x": -1})
    assert importlib.import_module("torchrl_hmcts.planners").UCT is planners.UCT

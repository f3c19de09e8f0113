"""Every public constructor, given what makes no sense: it refuses by name, or it works.

A case replaces one to three arguments of a valid call. It may be accepted, or end in an error that
has the argument's name, its value or the value's type; never in a KeyError or the like, in a NaN
that is taken for a number, or in no end.
"""

from __future__ import annotations

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
from torchrl.data import Bounded, OneHot, Unbounded
from torchrl.modules import UCBScore
from torchrl.trainers import Trainer

from torchrl_hmcts import envs, modules, objectives, planners, trainers, transforms
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers.experiments.kits.waterworld import make_training_env
from torchrl_hmcts.trainers.experiments.settings import (
    LabMazeConfig,
    WaterworldA3CConfig,
    WaterworldGoalsConfig,
)

pytestmark = pytest.mark.filterwarnings("ignore")  # torch may warn of what it then accepts
Good = Callable[[], tuple[Callable[..., Any], dict[str, Any]]]
IN, SPEC, BOUNDED = ("velocity",), OneHot(4), Bounded(-1, 1, (2,))
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


def critic() -> Any:
    return modules.SkillCritic(2, 4, 4, in_keys=IN, hidden=(4,))


def discriminator() -> Any:
    return modules.SkillDiscriminator(2, 4)


def objective() -> Any:
    return objectives.SkillDiscriminatorLoss(discriminator())


def termination() -> Any:
    return modules.TerminationNetwork(2, 4, in_keys=IN, hidden=(4,))


def option_model() -> Any:
    make = partial(nn.Linear, 3)
    return modules.OptionModel(lambda n: make(n), ["state"], {"state": 1}, max_duration=5)


def of(name: str, cls: Callable[..., Any], **good: Any) -> tuple[str, Good]:
    """An entry of the table: values that are functions without name are made anew for each case."""

    def make() -> tuple[Callable[..., Any], dict[str, Any]]:
        made = {k: v() if getattr(v, "__name__", "") == "<lambda>" else v for k, v in good.items()}
        return cls, made

    return name, make


def everything(package: Any, **table: dict[str, Any]) -> dict[str, Good]:
    return dict(of(name, getattr(package, name), **good) for name, good in table.items())


SIZES = {"in_features": 2, "num_skills": 4, "hidden": (4,)}
LOSS = {"actor_network": lambda: actor(), "qvalue_network": lambda: critic()}
GOOD: dict[str, Good] = {
    **everything(
        planners,
        PUCT={},
        UCT={},
        BestPlan={},
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
        GoalPlanner={"planner": lambda: planner(), "to_macro": abs, "goal_key": "state"},
        SearchSettings={},
        SearchTree={"num_roots": 2, "num_options": 3},
        Search={
            "num_roots": 2,
            "num_options": 3,
        },
    ),
    **everything(
        modules,
        FixedSkillPrior={"num_skills": 4},
        LearnedSkillPrior={"num_skills": 4},
        GrowingSkillPrior={"num_skills": 4},
        ConcatSkillMLP={**SIZES, "out_features": 3},
        SkillMLP={**SIZES, "out_features": 3},
        SkillActor={**SIZES, "action_spec": SPEC, "in_keys": IN},
        SkillCritic={**SIZES, "num_actions": 4, "in_keys": IN},
        SkillActionCritic={**SIZES, "action_features": 2, "in_keys": IN},
        SkillDiscriminator=SIZES,
        SkillDynamics={**SIZES, "target_features": 2},
        SkillEncoder=SIZES,
        SpectralLinear={"in_features": 2, "out_features": 3},
        SkillPolicy={"actor": lambda: actor()},
        StallTermination={"num_steps": 3},
        TerminationNetwork={"in_features": 2, "num_options": 4, "in_keys": IN, "hidden": (4,)},
        LearnedTermination={"network": lambda: termination()},
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
        DiscreteSkillSACLoss={**LOSS, "objective": lambda: objective(), "action_space": SPEC},
        SkillSACLoss={
            "actor_network": lambda: modules.SkillActor(2, BOUNDED, 4, in_keys=IN, hidden=(4,)),
            "qvalue_network": lambda: modules.SkillActionCritic(2, 2, 4, in_keys=IN, hidden=(4,)),
            "objective": lambda: objective(),
            "action_spec": BOUNDED,
        },
        SkillDiscriminatorLoss={"discriminator": lambda: discriminator()},
        METRAEncoderLoss={"encoder": lambda: modules.SkillEncoder(2, 4, hidden=(4,))},
        LSDEncoderLoss={
            "encoder": lambda: modules.SkillEncoder(2, 4, linear=modules.SpectralLinear)
        },
        SkillDynamicsLoss={"dynamics": lambda: modules.SkillDynamics(2, 2, 4, hidden=(4,))},
        SkillPriorLoss={"prior": lambda: modules.LearnedSkillPrior(4)},
        OptionModelLoss={"model": lambda: option_model()},
        ExpertIterationLoss={"network": lambda: linear(2, 4, "velocity", "logits")},
        OptionTerminationLoss={"termination_network": lambda: termination()},
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
        SkillReward={"objective": lambda: objective()},
        SkillMaskTransform={"prior": lambda: modules.GrowingSkillPrior(4)},
        SkillTransform={"num_skills": 4},
        SubgoalTransform={"planner": abs},
    ),
    **everything(
        envs,
        GridworldMazeEnv={},
        WaterworldMazeEnv={},
        LabMazeEnv={"maze_seeds": range(2)},
        GridFeatures={},
        GridMoves={},
        MazeItems={"apples": 2},
        RepeatActions={"actions": 3},
        SharedMLP={"num_options": 2, "num_actions": 3, "hidden": (4,)},
    ),
    **everything(
        trainers,
        SearchGuide={"num_options": 3, "hidden": (4,), "buffer_size": 8},
        ReactiveManager={"num_options": 3, "hidden": (4,), "buffer_size": 8},
        OptionGoals={"goals": [0, 2]},
        AtariSearch={},
        RuleSource={},
        DemoConfig={},
        StateCoverage={},
        ScriptedExpert={},
        SharedRMSprop={"params": lambda: [nn.Parameter(torch.zeros(2))]},
        GrowSkills={"prior": lambda: modules.GrowingSkillPrior(4), "coverage": float},
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
    *("WaterworldMazeEnv", "LabMazeEnv", "GridworldMazeEnv"),
    *("DIAYNLoss", "DiscreteSkillSACLoss", "SkillSACLoss", "A3CLoss", "OptionModel"),
    *("IntraOptionQLoss", "OptionTerminationLoss", "ExpertIterationLoss", "SkillDynamicsLoss"),
}
EXCLUDED = {  # why public names are not fuzzed here
    "a record that is filled": "NodeStatistics Plan TreeView Root SearchProgress Transition "
    "Evaluation GoalTrack Options Controllability Solution MujocoTask",
    "a protocol": "NoveltyTest PlansGoals OptionWorker",
    "a base class": "Kit SkillObjective SkillPrior ResumableTrainer",
    "starts processes": "AtariOptionPool AtariRAMEnv DeepMindLabEnv OptionPool",
    "takes an env, a folder, transitions or callables, and has its own tests": "StatelessSimulator "
    "SkillWorker PolicyWorker GridView MujocoBatch HMCTS "
    "EffectModel LandmarkEnv LandmarkModel GoalCloningLoss AttributeSnapshot ReplaySnapshot "
    "SettableGymEnv Snapshot OptionModelEnv TorchRLGymnasiumEnv "
    "DurableRotation",
    "is the base of configs that are fuzzed": "SkillsConfig",
    "hands its arguments to SkillReward": "SkillRewardHook",
    "searches from any object": "ReferenceSearch",
    "is built by the kit gym": "FeatureGoal",
    "belongs to an Atari game": "ByteGoal FollowGoals JoinedWorkers OccasionalAction AtariAgent "
    "AtariKit TrainedSource",
    "the arguments of TorchRL's ValueEstimatorBase": "NStepReturn",
    "the arguments of TorchRL's Unbounded": "UnitSphere",
    "an exception": "CollectorError FolderInUse LearnerError SnapshotError",
    "takes other parts, whose types it checks": "GeneratorStates RunningEpisodes "
    "SearchCoverage TilePlanner",
}

NAN, NO_ROWS = float("nan"), torch.zeros(0)
ROWS = TensorDict(a=torch.zeros(2), batch_size=[2])
NASTY: list[Any] = [
    *(None, True, -1, 0, 1, 2, 2**62, -(2**62), 0.0, -0.5, 1.5, 1e300),
    *(NAN, float("inf"), float("-inf"), np.float64("nan"), np.int64(-3), complex(1, 1)),
    *("", "x", "no such thing", b"bytes", (), [], {}, set()),
    *((-1,), (0,), (2.5,), ("a", "b"), [None], {"a": 1}, object(), object, len),
    *(NO_ROWS, torch.tensor(NAN), torch.ones(2, 2), np.zeros(3), ROWS, OneHot(2)),
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
    """Whether a message has a value, its shape, its type or that of what it holds."""
    texts = {repr(value), str(value), type(value).__name__, getattr(value, "__name__", "")}
    if isinstance(value, (torch.Tensor, np.ndarray)):
        texts |= {str(list(value.shape)), str(value.shape), str(value.dtype), "array"}
        texts |= {str(value.item())} if value.shape == () else set()
    if isinstance(value, (tuple, list, set, dict)):
        texts |= {repr(item) for item in value} | {type(item).__name__ for item in value}
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        texts |= {f"{value:g}", f"{value:,}"}
    if value is NO_ROWS or (isinstance(value, (str, tuple, list, set, dict)) and not value):
        texts.add("got none")
    return any(text and text.lower() in message.lower() for text in texts)


def close(made: Any) -> None:
    if isinstance(made, Trainer):
        made.collector.shutdown()


# What says that an argument is wrong, wherever it is found out.
REFUSALS = (ValueError, TypeError, AttributeError, RuntimeError, OverflowError, OSError)


def parameters(call: Callable[..., Any]) -> dict[str, str]:
    """The names of the arguments with their annotations, those behind ``**kwargs`` too."""
    found: dict[str, str] = {}
    for each in call.__mro__ if inspect.isclass(call) else (call,):
        if found and not each.__module__.startswith("torchrl_hmcts"):
            break
        given = inspect.signature(each).parameters.values()
        plain = {p.name: str(p.annotation) for p in given if "VAR" not in p.kind.name}
        found = {**plain, **found}
        if "VAR_KEYWORD" not in {p.kind.name for p in given}:
            break
    return found


def complaint(call: Callable[..., Any], good: Mapping[str, Any], bad: Mapping[str, Any]) -> str:
    """Returns what is wrong with how a call takes bad arguments; empty if nothing is."""
    shown = f"{getattr(call, '__name__', call)}({', '.join(f'{k}={v!r}' for k, v in bad.items())})"
    signal.setitimer(signal.ITIMER_REAL, 10.0)
    try:
        made = call(**{**good, **bad})
    except REFUSALS as error:
        message = str(error)
        words = {word.rstrip("s") for name in bad for word in (name, name.split("_")[-1])}
        names = any(re.search(rf"\b{re.escape(word)}", message) for word in words)
        if names or any(shows(value, message) for value in bad.values()):
            return ""
        vast = any(isinstance(value, int) and value > 2**40 for value in bad.values())
        if vast and re.search("allocate memory|overflow", message, re.IGNORECASE):
            return ""
        return f"{shown} does not say what: {type(error).__name__}: {message[:200]}"
    except Hang:
        return f"{shown} takes more than ten seconds"
    except MemoryError:
        return ""
    except Exception as error:
        return f"{shown} ends in {type(error).__name__}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    close(made)
    numbers = [k for k, kind in parameters(call).items() if re.search(r"\b(float|int)\b", kind)]
    nans = [k for k, v in bad.items() if isinstance(v, float) and math.isnan(v) and k in numbers]
    return f"{shown} accepts NaN" if nans else ""


def fuzz(name: str, cases: int) -> None:
    call, _ = GOOD[name]()
    names = list(parameters(call))
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
    excluded = set(" ".join(EXCLUDED.values()).split())
    assert public - set(GOOD) - excluded == set()
    assert not set(GOOD) & excluded


@pytest.mark.parametrize("name", GOOD)
def test_the_valid_call_is_valid(name: str) -> None:
    call, good = GOOD[name]()
    made = call(**good)
    close(made)


@pytest.mark.parametrize("name", GOOD)
def test_what_makes_no_sense_is_refused_by_name(name: str) -> None:
    call, _ = GOOD[name]()
    for parameter in list(parameters(call))[:3]:  # one by one first: the plainest failure is shown
        for value in NASTY:
            if name in COSTLY and not isinstance(value, float):
                continue
            CASES[name] += 1
            assert not complaint(call, GOOD[name]()[1], {parameter: value})
    fuzz(name, 30 if name in COSTLY else 60)


# What must not be accepted, of arguments whose range is a part of their meaning.
OUT_OF_RANGE: dict[str, dict[str, tuple[Any, ...]]] = {
    "A3CLoss": {
        "gamma": (1.5,),
        "entropy_coeff": (-1.0,),
        "critic_coeff": (0.0,),
        "reduction": ("median",),
    },
    "DIAYNLoss": {"gamma": (1.5,), "alpha_init": (0.0,), "reduction": ("median",)},
    "FixedSkillPrior": {
        "weights": ([1.0] * 3, [-1.0, 2.0, 0.0, 0.0], [0.0] * 4, [1.0, math.inf, 0.0, 0.0])
    },
    "GrowingSkillPrior": {"num_skills": (0,), "num_active": (0, 5)},
    "IntraOptionQLoss": {"gamma": (1.5,)},
    "LearnedSkillPrior": {"logits": ([0.0], [NAN] * 4)},
    "LearnedTermination": {"every": (0,), "termination_logits_key": ("beta",)},
    "METRAEncoderLoss": {"dual_init": (-1.0, 0.0), "slack": (-1.0,)},
    "OptionMemory": {"radius": (-1.0,), "capacity": (0,)},
    "OptionModel": {"num_models": (0,), "delta_keys": ({},)},
    "OptionModelLoss": {"reward_coeff": (-1.0,), "reduction": ("median",)},
    "OptionRecorder": {"keys": (["skill"],)},
    "OptionTerminationLoss": {"deliberation_cost": (-0.1,), "reduction": ("max",)},
    "OptionTransform": {
        "worker": ("walk",),
        "num_options": (0, -3),
        "max_steps": (0, 2.5, True),
        "gamma": (0.0, 1.1, NAN),
        "worker_memory": ("never",),
    },
    "SkillActor": {
        "action_spec": (
            Unbounded((1,)),
            Bounded(-1.0, math.inf, (1,)),
            Bounded(-1.0, 1.0, ()),
            Bounded(0, 5, (1,), dtype=torch.int64),
        )
    },
    "SkillCritic": {"in_keys": ([],)},
    "SkillDynamics": {"std": (1e-4,)},
    "SkillMLP": {"num_skills": (0,), "hidden": ((), (64, 0))},
    "SkillMaskTransform": {"prior": ([1.0, 0.0],)},
    "SkillPolicy": {"actor": (nn.Linear(2, 2),)},
    "SkillPriorLoss": {
        "prior": (modules.GrowingSkillPrior(2),),
        "entropy_coeff": (-1.0,),
        "decay": (1.1,),
        "reduction": ("max",),
    },
    "SkillReward": {"objective": (nn.Linear(2, 2),)},
    "SkillTransform": {
        "num_skills": (0,),
        "max_skill_steps": (0,),
        "prior": ([0.2, 0.8], [-1.0, 1.0, 1.0, 1.0]),
    },
    "StallTermination": {"num_steps": (0, 2.0, True)},
    "StallTransform": {"tolerance": (-1,)},
    "SubgoalTransform": {
        "planner": (3,),
        "goal_met_threshold": (0.0,),
        "goal_divergence_threshold": (0.5, NAN),
        "r_tick": (math.inf,),
        "r_goal_met": (NAN,),
        "r_goal_divergence": (1.0,),
        "num_goals": (0,),
        "max_goals": (0,),
    },
    "TerminationNetwork": {"initial_probability": (1.0,)},
}


@pytest.mark.parametrize("name", OUT_OF_RANGE)
def test_a_value_out_of_its_range_is_refused_by_name(name: str) -> None:
    for argument, values in OUT_OF_RANGE[name].items():
        for value in values:
            call, good = GOOD[name]()
            with pytest.raises((TypeError, ValueError)) as raised:
                call(**{**good, argument: value})
            message = str(raised.value)
            assert argument in message or shows(value, message), message


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
    def silent(x: float = 0) -> None:
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

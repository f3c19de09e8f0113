"""Configs in Hydra's store: they are what their classes are, and compose with TorchRL's."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from hydra import compose, initialize
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from omegaconf import MISSING, DictConfig
from tensordict import TensorDictBase
from torchrl.data import Bounded, Composite
from torchrl.envs import EnvBase, Transform

import torchrl_hmcts.envs
import torchrl_hmcts.objectives
import torchrl_hmcts.planners
import torchrl_hmcts.transforms
from torchrl_hmcts import objectives
from torchrl_hmcts.planners import PUCT, RadiusNovelty, WidthNovelty
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers.command_line.words import expand, parse_config
from torchrl_hmcts.trainers.configs import COMPONENTS, config_of
from torchrl_hmcts.trainers.experiments.kits import make_kit
from torchrl_hmcts.trainers.experiments.kits.waterworld import WaterworldKit
from torchrl_hmcts.trainers.experiments.registry import DEMO, EXPERIMENTS, find_experiment
from torchrl_hmcts.trainers.experiments.settings import DemoConfig
from torchrl_hmcts.trainers.experiments.skills import learn, make_loss
from torchrl_hmcts.trainers.parts import build, differences, keywords_of, merged, named

CONFIGS = [(f"{g}={n}", p) for g, names in COMPONENTS.items() for n, p in names.items()]
INTERNAL = {"_target_", "_component_", "_partial_"}


@pytest.fixture(autouse=True, scope="module")
def hydra() -> Iterator[None]:
    GlobalHydra.instance().clear()
    with initialize(version_base=None):
        yield
    GlobalHydra.instance().clear()


def as_written(value: Any) -> Any:
    """A class's default as a config can hold it."""
    if isinstance(value, tuple | list | range):
        return [as_written(item) for item in value]
    if isinstance(value, dict):
        return {key: as_written(item) for key, item in value.items()}
    return value


@pytest.mark.parametrize(("name", "path"), CONFIGS, ids=[name for name, _ in CONFIGS])
def test_a_config_has_the_keywords_and_defaults_of_its_class(name: str, path: str) -> None:
    parameters = keywords_of(named(path))
    config = {k: v for k, v in vars(config_of(path)()).items() if k not in INTERNAL}
    assert sorted(config) == sorted(parameters)
    for key, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty:
            assert config[key] == MISSING, key
        elif callable(parameter.default) or isinstance(parameter.default, torch.dtype):
            assert named(config[key]) is parameter.default, key
        else:
            assert config[key] == as_written(parameter.default), key


# Built by others, or no part that one would choose in a config.
NOT_CONFIGURED = {
    "torchrl_hmcts.planners": {
        "NodeStatistics", "NoveltyTest", "Plan", "Root", "Search", "SearchProgress", "SearchTree",
        "Transition", "TreeView", "Evaluation", "ReferenceSearch", "SearchSettings",
    },
    "torchrl_hmcts.objectives": {"NStepReturn", "SkillObjective"},
    "torchrl_hmcts.transforms": {"PlansGoals"},
    # Own processes and workers; another program.
    "torchrl_hmcts.envs": {"AtariOptionPool", "DeepMindLabEnv", "OptionPool"},
}  # fmt: skip


@pytest.mark.parametrize("package", NOT_CONFIGURED)
def test_every_class_that_can_be_swapped_has_a_config(package: str) -> None:
    module = getattr(torchrl_hmcts, package.rpartition(".")[2])
    public = {n for n in module.__all__ if inspect.isclass(getattr(module, n))}
    if package.endswith(".envs"):
        public = {n for n in public if issubclass(getattr(module, n), EnvBase)}
    configured = {path.rpartition(".")[2] for _, path in CONFIGS}
    missing = public - configured - NOT_CONFIGURED[package]
    assert not missing, f"without a config in trainers/configs: {sorted(missing)}"


def test_a_planner_is_composed_of_parts_with_other_values() -> None:
    config = compose(
        overrides=[
            "+planner=mcts",
            "+tree_policy=puct",
            "+novelty=radius",
            "+budget=search",
            "planner.tree_policy.c=2.5",
            "planner.novelty.key=state",
            "planner.novelty.radius=0.5",
            "planner.budget.simulations=7",
            "planner.gamma=0.9",
            "planner.backup=max",
        ]
    )
    planner = instantiate(config.planner, _partial_=True)(env=ChainEnv(length=5))
    assert planner.tree_policy == PUCT(c=2.5)
    assert isinstance(planner.novelty, RadiusNovelty)
    assert planner.backup == "max"
    assert planner.budget.simulations == 7
    assert planner.gamma == 0.9


def test_a_nested_key_is_given_as_a_list() -> None:
    config = compose(
        overrides=["+transform@skill=skill", "skill.num_skills=3", "skill.skill_key=[agent,skill]"]
    )
    assert instantiate(config.skill).skill_key == ("agent", "skill")


def test_a_class_is_given_by_its_name() -> None:
    config = compose(
        overrides=[
            "+model@net=skill_critic",
            "net.in_features=2",
            "net.num_actions=4",
            "net.num_skills=3",
            "net.in_keys=[velocity]",
            "net.activation=torch.nn.Tanh",
        ]
    )
    assert any(isinstance(module, torch.nn.Tanh) for module in instantiate(config.net).modules())


def waterworld_with_skills() -> list[str]:
    """Overrides for the env of DIAYN's training: Waterworld under two transforms."""
    return [
        "+env@base=waterworld",
        "base.batch_size=[8]",
        "base.observation=false",
        "+transform@skill=skill",
        "skill.num_skills=3",
        "skill.max_skill_steps=10",
        "+transform@displacement=displacement",
        "+transform@transforms=compose",
        "transforms.transforms=[${skill},${displacement}]",
        "+env=transformed_env",
        "env.base_env=${base}",
        "env.transform=${transforms}",
    ]


@pytest.mark.filterwarnings("ignore:SACTrainer is an experimental:UserWarning")
@pytest.mark.filterwarnings("ignore:The .* hook stage will be replaced:FutureWarning")
def test_torchrls_sac_trainer_trains_skills_from_configs_alone() -> None:
    networks = [
        *(f"+model@{n}=skill_{n}" for n in ("actor", "critic", "discriminator")),
        *(f"{n}.num_skills=3" for n in ("actor", "critic", "discriminator")),
        *(f"{n}.in_features=2" for n in ("actor", "critic", "discriminator")),
        *(f"{n}.in_keys=[velocity]" for n in ("actor", "critic")),
        "critic.num_actions=4",
        "+action_spec@actor.action_spec=categorical",
        "actor.action_spec.n=4",
    ]
    overrides = [
        *waterworld_with_skills(),
        *networks,
        "+trainer=sac",
        "+collector@trainer.collector=sync",
        "trainer.collector.create_env_fn=${env}",
        "trainer.collector.policy=${actor}",
        "trainer.collector.frames_per_batch=32",
        "trainer.collector.total_frames=64",
        "trainer.collector.auto_register_policy_transforms=false",
        "trainer.collector._partial_=false",
        "+loss@trainer.loss_module=diayn",
        "trainer.loss_module._partial_=true",
        "trainer.loss_module.action_space=categorical",
        "trainer.loss_module.discriminator=${discriminator}",
        "+replay_buffer@trainer.replay_buffer=base",
        "trainer.replay_buffer.batch_size=16",
        "+storage@trainer.replay_buffer.storage=lazy_tensor",
        "trainer.replay_buffer.storage.max_size=64",
        "+target_net_updater@trainer.target_net_updater=soft",
        "trainer.target_net_updater.tau=0.5",
        "+optimizer@trainer.optimizer=adam",
        "trainer.optimizer.lr=0.01",
        "trainer.actor_network=${actor}",
        "trainer.critic_network=${critic}",
        "trainer.total_frames=64",
        "trainer.optim_steps_per_batch=1",
        "trainer.logger=null",
        "trainer.save_trainer_file=null",
        "trainer.progress_bar=false",
        "trainer.enable_logging=false",
        "+hook@reward=skill_reward",
        "trainer.hooks=[${reward}]",
    ]
    trainer = instantiate(compose(overrides=overrides).trainer)
    before = {name: p.clone() for name, p in trainer.loss_module.named_parameters()}
    trainer.train()
    after = dict(trainer.loss_module.named_parameters())
    for part in ("actor_network", "qvalue_network", "discriminator"):
        assert any((after[n] != p).any() for n, p in before.items() if part in n), part
    sampled = trainer.replay_buffer.sample()
    reward = trainer.loss_module.objective.reward(sampled)
    torch.testing.assert_close(sampled["next", "reward"], reward)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiments_compose_too(name: str) -> None:
    config = compose(overrides=[f"+experiment={name}", "experiment.seed=5"])
    assert isinstance(config, DictConfig)
    assert instantiate(config.experiment).seed == 5
    assert config.experiment.out == f"runs/{name}"


class Pushed(WaterworldKit):
    """Waterworld whose disc is pushed by two numbers, of which the larger one decides."""

    def make_training_env(self, num_envs: int = 32) -> EnvBase:
        return super().make_training_env(num_envs).append_transform(_Pushes())


class _Pushes(Transform):
    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", tensordict["action"].argmax(-1))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        spec = Bounded(-1.0, 1.0, shape=(*self.parent.batch_size, 2))
        input_spec["full_action_spec", "action"] = spec
        return input_spec


class TestParts:
    """Parts of an agent over a kit, as they are typed on the command line."""

    def test_what_differs_from_the_kits_own_is_kept(self) -> None:
        words = ["objective=metra", "objective.slack=0.01", "planner/tree_policy=puct", "mazes=7"]
        words += ["planner/novelty=radius", "planner.novelty.radius=0.5", "trainer.buffer_size=99"]
        config = parse_config(find_experiment("labmaze"), words)
        assert config.mazes == 7
        assert config.objective["_component_"] == "torchrl_hmcts.objectives.METRAEncoderLoss"
        assert config.objective["slack"] == 0.01
        assert config.planner["novelty"] == {"radius": 0.5}  # key and all else as in the kit
        assert build(**config.planner["tree_policy"]) == PUCT()
        assert (config.trainer, config.loss) == ({"buffer_size": 99}, {})

    def test_the_kits_own_part_chosen_by_name_changes_nothing(self) -> None:
        words = ["objective=diayn", "planner/novelty=radius", "planner/budget=search"]
        assert parse_config(DEMO, words) == DemoConfig()

    def test_another_class_takes_over_what_it_needs(self) -> None:
        config = parse_config(DEMO, ["planner/novelty=width"])
        novelty = build(**config.planner["novelty"])
        assert repr(novelty) == repr(WidthNovelty("position"))

    def test_further_words_change_a_configuration_that_is_composed(self) -> None:
        before = parse_config(DEMO, ["planner/tree_policy=puct", "planner.tree_policy.c=3"])
        after = parse_config(DEMO, ["planner.tree_policy.c_base=20", "novelty_radius=2"], before)
        assert build(**after.planner["tree_policy"]) == PUCT(c=3.0, c_base=20.0)
        planner = make_kit(after).planner_part()
        assert merged(planner, after.planner)["novelty"]["radius"] == 2.0

    @pytest.mark.parametrize(
        ("word", "message"),
        [
            ("objective=metr", "Unknown objective 'metr'. Did you mean: metra"),
            ("planner/tree_polcy=puct", "Did you mean: planner/tree_policy"),
            ("planner/tree_policy=puctt", "Unknown tree_policy 'puctt'. Did you mean: puct"),
            ("planner.nvelty.radius=1", "Did you mean: planner.novelty.radius"),
            ("planner.waves_in_flihgt=2", "Did you mean: planner.waves_in_flight"),
            ("planner.leaves_per_wave=many", "planner.leaves_per_wave"),
            ("loss.gama=0.9", "Did you mean: loss.gamma"),
            ("loss.gamma=2", "gamma"),
            ("loss=skill_sac", "These do: DIAYNLoss, DiscreteSkillSACLoss"),
            ("loss=a3c", "These do: DIAYNLoss, DiscreteSkillSACLoss"),
            ("loss=option_model", "These do: DIAYNLoss, DiscreteSkillSACLoss"),
            ("loss.num_skills=3", "num_skills, not loss.num_skills"),
            ("planner/transpositions=by_key", "planner.transpositions needs key"),
            ("planner.novelty.radius=-1", "radius"),
            ("planner.budget=3", "planner.budget is a part; got 3. Write planner/budget=NAME"),
            ("planner.backup=median", "backup must be 'mean' or 'max'; got 'median'"),
            ("planner.waves_in_flight=0", "waves_in_flight"),
            ("planner.gamma=2", "gamma"),
            ("planner", "no key=value"),
        ],
    )
    def test_what_cannot_be_composed_names_the_nearest(self, word: str, message: str) -> None:
        with pytest.raises((ValueError, TypeError), match=re.escape(message)):
            parse_config(DEMO, [word])

    @pytest.mark.parametrize("name", COMPONENTS["objective"])
    def test_every_objective_learns_a_batch(self, name: str) -> None:
        config = parse_config(DEMO, [f"objective={name}", "train_base_steps=64"])
        learned = learn(make_kit(config))
        assert learned.steps == 64
        assert learned.loss.objective.num_skills == 4

    @pytest.mark.parametrize(
        ("words", "expected"),
        [
            ([], objectives.DIAYNLoss),
            (["loss=diayn"], objectives.DIAYNLoss),
            (["loss=discrete_skill_sac", "loss.alpha_init=0.2"], objectives.DiscreteSkillSACLoss),
            (["loss=DiscreteSkillSACLoss"], objectives.DiscreteSkillSACLoss),
            (["objective=metra"], objectives.DiscreteSkillSACLoss),
            (["objective=metra", "loss=discrete_skill_sac"], objectives.DiscreteSkillSACLoss),
        ],
    )
    def test_the_loss_is_chosen_by_its_name(self, words: list[str], expected: type) -> None:
        loss = make_loss(make_kit(parse_config(DEMO, words)))
        assert type(loss) is expected
        if "loss.alpha_init=0.2" in words:
            assert loss.log_alpha.exp().item() == pytest.approx(0.2)
            assert isinstance(loss.objective, objectives.SkillDiscriminatorLoss)

    def test_a_worker_that_acts_within_bounds_learns_with_skill_sac(self) -> None:
        kit = Pushed(DemoConfig(train_base_steps=64))
        assert kit.parts()["loss"]["_component_"].endswith(".SkillSACLoss")
        learned = learn(kit)
        assert type(learned.loss) is objectives.SkillSACLoss
        assert (learned.steps, learned.worker.out_keys) == (64, ["action"])

    @pytest.mark.parametrize(
        ("other", "changes"),
        [
            ({"c": 1, "part": {"a": 1}}, {}),
            ({"c": 2, "part": {"a": 1}}, {"c": 2}),
            ({"c": 1, "part": None}, {"part": None}),
            ({"c": 1, "part": {"a": 5}}, {"part": {"a": 5}}),
            ({"c": 1, "part": {"_component_": "x"}}, {"part": {"_component_": "x"}}),
        ],
    )
    def test_differences_are_what_makes_the_one_of_the_other(
        self, other: Any, changes: Any
    ) -> None:
        own = {"c": 1, "part": {"a": 1}}
        assert differences(own, other) == changes
        assert merged(own, changes) == other


def test_a_sweep_of_commas_is_every_combination() -> None:
    words = ["seed=0,1", "objective=metra,lsd", "planner.novelty.key=[a,b]"]
    runs = expand(words)
    assert len(runs) == 4
    assert runs[1] == ["seed=0", "objective=lsd", "planner.novelty.key=[a,b]"]

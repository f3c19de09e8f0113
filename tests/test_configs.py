"""Configs in Hydra's store: they are what their classes are, and compose with TorchRL's."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from hydra import compose, initialize
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import MISSING, DictConfig, OmegaConf
from torchrl.envs import EnvBase

import torchrl_hmcts.envs
import torchrl_hmcts.objectives
import torchrl_hmcts.planners
import torchrl_hmcts.transforms
from torchrl_hmcts.planners import PUCT, UCT, Gumbel, RadiusNovelty
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.trainers.configs import COMPONENTS, argument_docs, config_of, named, to_yaml
from torchrl_hmcts.trainers.experiments import EXPERIMENTS

CONFIGS = [(f"{g}={n}", named(p)) for g, names in COMPONENTS.items() for n, p in names.items()]
INTERNAL = {"_target_", "_component_", "_partial_"}


@pytest.fixture(autouse=True, scope="module")
def hydra() -> Iterator[None]:
    GlobalHydra.instance().clear()
    with initialize(version_base=None):
        yield
    GlobalHydra.instance().clear()


def keywords(component: type) -> dict[str, inspect.Parameter]:
    found: dict[str, inspect.Parameter] = {}
    for cls in component.__mro__:  # **kwargs stand for the arguments of the class above
        if cls is component or cls.__module__.startswith("torchrl_hmcts"):
            given = inspect.signature(cls.__init__).parameters if "__init__" in vars(cls) else {}
            found = {**given, **found}
            if given and "VAR_KEYWORD" not in {p.kind.name for p in given.values()}:
                break
        else:
            break
    return {n: p for n, p in found.items() if n != "self" and "VAR" not in p.kind.name}


def as_written(value: Any) -> Any:
    """A class's default as a config can hold it."""
    if isinstance(value, tuple | list | range):
        return [as_written(item) for item in value]
    if isinstance(value, dict):
        return {key: as_written(item) for key, item in value.items()}
    return value


@pytest.mark.parametrize(("name", "component"), CONFIGS, ids=[name for name, _ in CONFIGS])
def test_a_config_has_the_keywords_and_defaults_of_its_class(name: str, component: type) -> None:
    parameters = keywords(component)
    config = {k: v for k, v in vars(config_of(component)()).items() if k not in INTERNAL}
    assert sorted(config) == sorted(parameters)
    for key, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty:
            assert config[key] == MISSING, key
        elif callable(parameter.default) or isinstance(parameter.default, torch.dtype):
            assert named(config[key]) is parameter.default, key
        else:
            assert config[key] == as_written(parameter.default), key


@pytest.mark.parametrize(("name", "component"), CONFIGS, ids=[name for name, _ in CONFIGS])
def test_the_yaml_explains_every_key_in_the_words_of_the_docstring(
    name: str, component: type
) -> None:
    written = to_yaml(component)
    assert set(OmegaConf.create(written)) == {*keywords(component), "_target_", "_component_"}
    if component.__module__.startswith("torchrl_hmcts"):
        assert set(argument_docs(component)) >= set(keywords(component))
        comments = sum(line.startswith("# ") for line in written.splitlines())
        assert comments >= len(keywords(component))


# Built by others, or no part that one would choose in a config.
NOT_CONFIGURED = {
    "torchrl_hmcts.planners": {
        "NodeStatistics", "NoveltyTest", "Plan", "Root", "Search", "SearchProgress", "SearchTree",
        "Transition", "TreeView", "Evaluation", "ReferenceSearch", "SearchSettings",
    },
    "torchrl_hmcts.objectives": {"NStepReturn", "SkillObjective"},
    "torchrl_hmcts.transforms": {"PlansGoals"},
    # Own processes and workers; another program.
    "torchrl_hmcts.envs": {"AtariOptionPool", "DeepMindLabEnv"},
}  # fmt: skip


@pytest.mark.parametrize("package", NOT_CONFIGURED)
def test_every_class_that_can_be_swapped_has_a_config(package: str) -> None:
    module = getattr(torchrl_hmcts, package.rpartition(".")[2])
    public = {n for n in module.__all__ if inspect.isclass(getattr(module, n))}
    if package.endswith(".envs"):
        public = {n for n in public if issubclass(getattr(module, n), EnvBase)}
    configured = {component.__name__ for _, component in CONFIGS}
    missing = public - configured - NOT_CONFIGURED[package]
    assert not missing, f"without a config in trainers/configs: {sorted(missing)}"


@pytest.mark.parametrize(
    ("name", "policy", "more"),
    [
        ("uct", UCT(), []),
        ("puct", PUCT(), []),
        (
            "gumbel",
            Gumbel(),
            [
                "planner.expand=one",
                "+budget=search",
                "planner.budget.simulations=8",
                "planner.budget.until_plan=false",
            ],
        ),
    ],
    ids=["uct", "puct", "gumbel"],
)
def test_a_tree_policy_goes_into_the_planner(name: str, policy: object, more: list[str]) -> None:
    config = compose(overrides=["+planner=mcts", f"+tree_policy={name}", *more])
    planner = instantiate(config.planner, _partial_=True)(env=ChainEnv(length=5))
    assert planner.tree_policy == policy


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


def test_a_part_of_an_unknown_name_is_refused_by_hydra() -> None:
    with pytest.raises(Exception, match="tree_policy/uctt"):
        compose(overrides=["+planner=mcts", "+tree_policy=uctt"])


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


def test_diayn_composes_with_torchrls_env_collector_and_optimizer() -> None:
    overrides = [
        *waterworld_with_skills(),
        "+collector=sync",
        "collector.create_env_fn=${env}",
        "collector.frames_per_batch=32",
        "collector.total_frames=32",
        "collector.auto_register_policy_transforms=false",
        "+model@actor=skill_actor",
        "+model@critic=skill_critic",
        "+model@discriminator=skill_discriminator",
        *(f"{n}.num_skills=3" for n in ("actor", "critic", "discriminator")),
        *(f"{n}.in_features=2" for n in ("actor", "critic", "discriminator")),
        *(f"{n}.in_keys=[velocity]" for n in ("actor", "critic")),
        "critic.num_actions=4",
        "+loss=diayn",
        "loss.action_space=categorical",
        "+target_net_updater=soft",
        "target_net_updater.tau=0.5",
        "+optimizer=adam",
        "optimizer.lr=0.01",
    ]
    config = compose(overrides=overrides)
    env = instantiate(config.env)
    actor = instantiate(config.actor, _partial_=True)(action_spec=env.action_spec_unbatched)
    loss = instantiate(config.loss, _partial_=True)(
        actor_network=actor,
        qvalue_network=instantiate(config.critic),
        discriminator=instantiate(config.discriminator),
    )
    updater = instantiate(config.target_net_updater, _partial_=True)(loss)
    optimizer = instantiate(config.optimizer, _partial_=True)(params=loss.parameters())
    collector = instantiate(config.collector, _partial_=True)(
        create_env_fn=lambda: env, policy=actor
    )
    (batch,) = list(collector)
    before = [p.clone() for p in loss.parameters()]
    batch.set(("next", "reward"), torch.zeros(*batch.shape, 1))
    values = loss(batch.reshape(-1))
    sum(values[key] for key in values.keys() if key.startswith("loss")).backward()
    optimizer.step()
    updater.step()
    assert values["loss_discriminator"].isfinite()
    assert any((a != b).any() for a, b in zip(before, loss.parameters(), strict=True))
    collector.shutdown()


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


def test_an_objective_goes_into_the_skill_loss() -> None:
    config = compose(overrides=["+loss=discrete_skill_sac", "+objective=metra"])
    assert config.loss.objective._component_.endswith("METRAEncoderLoss")
    assert config.loss.objective.slack == 1e-3


def test_what_is_missing_is_named() -> None:
    config = compose(overrides=["+transform@skill=skill"])
    with pytest.raises((InstantiationException, Exception), match="num_skills"):
        instantiate(config.skill)


def test_torchrls_own_groups_are_still_there() -> None:
    store = ConfigStore.instance()
    assert {"sac.yaml", "diayn.yaml", "a3c.yaml"} <= set(store.list("loss"))
    assert {"step_counter.yaml", "option.yaml"} <= set(store.list("transform"))
    assert {"sync.yaml"} <= set(store.list("collector"))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiments_compose_too(name: str) -> None:
    config = compose(overrides=[f"+experiment={name}", "experiment.seed=5"])
    assert isinstance(config, DictConfig)
    assert instantiate(config.experiment).seed == 5
    assert config.experiment.out == f"runs/{name}"

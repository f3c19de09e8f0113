"""OptionTransform against a loop written here by hand, in every kind of env, and bad input."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, TensorDictModule
from torch import nn
from torchrl.data import (
    Composite,
    Unbounded,
)
from torchrl.envs import (
    Compose,
    GymEnv,
    ParallelEnv,
    RewardScaling,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs, step_mdp
from torchrl.modules import ProbabilisticActor

from torchrl_hmcts.envs import WaterworldMazeEnv, maze_from_text
from torchrl_hmcts.planners import MCTSPlanner, RadiusNovelty
from torchrl_hmcts.testing import ChainEnv
from torchrl_hmcts.transforms import OptionTransform

GAMMA = 0.9
BATCHES = [[], [3], [2, 3]]
LEFT, RIGHT = 0, 1


class Hidden(nn.Module):
    """A worker's network with something that train and eval mode change."""

    def __init__(self):
        super().__init__()
        self.norm = nn.BatchNorm1d(1)
        self.dropout = nn.Dropout(0.5)

    def forward(self, skill):
        return skill


def skill_is_action(action_key="action", skill_key="skill"):
    return TensorDictModule(lambda skill: skill.clone(), [skill_key], [action_key])


def chain(*, start=None, batch=(), **kwargs):
    env = ChainEnv(6, reward_per_step=-0.25, **kwargs)
    td = env.reset(TensorDict(batch_size=batch))
    return env, td if start is None else td.set("state", torch.tensor(start))


def macro(env, worker=None, num_options=2, max_steps=4, gamma=GAMMA, **kwargs):
    return TransformedEnv(
        env, OptionTransform(worker or skill_is_action(), num_options, max_steps, gamma, **kwargs)
    )


def macro_chain():
    return macro(ChainEnv(6, reward_per_step=-0.25))


def option_by_hand(env, td, worker, max_steps, termination=None, reward_key="reward"):
    """The macro-step of one element: the last base step's entries, reward, duration, base steps."""
    rewards, steps = [], []
    td = td.exclude("next").clone()
    option = td["option"]
    while True:
        td = env.step(worker(td.set("skill", option)))
        steps.append(td.clone())
        after = td["next"]
        rewards.append(after[reward_key])
        seen = after.clone().set("skill", option).set("duration", torch.tensor([len(steps)]))
        ends = termination is not None and bool(termination(seen))
        if ends or after["done"] or len(steps) == max_steps:
            break
        td = step_mdp(td)
    after = after.clone()
    after.set(reward_key, sum(GAMMA**i * reward for i, reward in enumerate(rewards)))
    after.set("duration", torch.tensor([len(rewards)]))
    return after, steps


def by_hand(env, td, worker, max_steps=4, termination=None, reward_key="reward"):
    """The macro-steps of a batch, element by element."""
    flat = td.reshape(-1)
    rows = [
        option_by_hand(env, flat[i], worker, max_steps, termination, reward_key)[0]
        for i in range(flat.shape[0])
    ]
    return torch.stack(rows).reshape(td.shape)


def assert_close(actual, expected):
    keys = set(expected.keys(True, True))
    assert keys <= set(actual.keys(True, True))
    for key in keys:
        left, right = actual[key], expected[key]
        assert left.shape == right.shape, key
        assert left.dtype == right.dtype, key
        torch.testing.assert_close(
            left, right, atol=1e-5, rtol=1e-5, msg=lambda m, k=key: f"{k}: {m}"
        )


def step_next(env, td, option):
    td = td.copy().set("option", torch.as_tensor(option))
    return env.step(td)["next"]


class TestAgainstALoop:
    def test_elements_end_at_different_steps(self):
        env, td = chain(start=[0, 4, 2, 3, 0], batch=[5])
        after = step_next(macro(env), td, [RIGHT, RIGHT, RIGHT, LEFT, LEFT])
        assert after["state"].tolist() == [4, 5, 5, 0, 0]
        assert after["duration"].flatten().tolist() == [4, 1, 3, 4, 4]
        for key in ("done", "terminated"):
            assert after[key].flatten().tolist() == [False, True, True, False, False]
        discounts = torch.tensor([1, 0.9, 0.81, 0.729])
        expected = [
            -0.25 * discounts.sum(),
            0.75,
            -0.25 * 1.9 + 0.75 * 0.81,
            -0.25 * discounts.sum(),
            -0.25 * discounts.sum(),
        ]
        torch.testing.assert_close(after["reward"].flatten(), torch.tensor(expected))

    @pytest.mark.parametrize("max_steps", [1, 2, 7, 30])
    @pytest.mark.parametrize("batch", BATCHES)
    def test_chains_of_any_batch_shape(self, batch, max_steps):
        env, td = chain(batch=batch)
        td["state"] = torch.randint(5, batch)
        td["option"] = torch.randint(2, batch)
        after = macro(env, max_steps=max_steps).step(td.clone())["next"]
        assert after.shape == td.shape
        assert_close(after, by_hand(env, td, skill_is_action(), max_steps))

    @pytest.mark.parametrize("batch", BATCHES)
    @pytest.mark.parametrize("shape", [(), (1,)])
    def test_a_termination_ends_an_option(self, batch, shape):
        """By the state, the option and the base steps taken, each for some elements."""

        def termination(td):
            at_two = (td["state"] == 2) & (td["skill"] == RIGHT)
            late = (td["duration"].squeeze(-1) >= 3) & (td["skill"] == LEFT)
            return (at_two | late).reshape((*td.shape, *shape))

        env, td = chain(batch=batch)
        td["state"] = torch.randint(5, batch)
        td["option"] = torch.randint(2, batch)
        after = macro(env, max_steps=6, termination=termination).step(td.clone())["next"]
        assert_close(after, by_hand(env, td, skill_is_action(), 6, termination))

    def test_a_root_can_be_stepped_again_with_another_option(self):
        """What the first step left under "next" is of no consequence for the second."""
        base, td = chain(start=[1, 3, 4], batch=[3])
        env = TransformedEnv(
            base,
            Compose(
                OptionTransform(skill_is_action(), 2, 4, GAMMA, trajectory_keys=["state"]),
                StepCounter(),
            ),
        )
        td = env.reset(td, set_state=True)
        env.step(td.set("option", torch.full((3,), LEFT)))
        after = env.step(td.set("option", torch.full((3,), RIGHT)))["next"]
        assert_close(after, by_hand(base, td.exclude("step_count"), skill_is_action()))
        assert after["trajectory", "mask"].sum(-1).tolist() == [4, 2, 1]


class TestStochasticWorker:
    def actor(self):
        return ProbabilisticActor(
            TensorDictModule(
                lambda skill: torch.stack([0.0 * skill, 1.0 * skill], -1),
                ["skill"],
                ["logits"],
            ),
            in_keys=["logits"],
            distribution_class=torch.distributions.Categorical,
            default_interaction_type=InteractionType.RANDOM,
        )

    def test_it_samples_as_a_loop_with_the_same_seed_does(self):
        base, td = chain(start=1)
        env = macro(base, self.actor(), max_steps=20)
        check_env_specs(env)
        durations = set()
        for seed in range(8):
            torch.manual_seed(seed)
            after = step_next(env, td, RIGHT)
            torch.manual_seed(seed)
            expected = by_hand(base, td.set("option", torch.tensor(RIGHT)), self.actor(), 20)
            assert_close(after, expected)
            durations.add(after["duration"].item())
        assert len(durations) > 2


class TestBatchedEnvs:
    """Two chains; the element at state 3 ends its option (and episode) after two base steps."""

    STARTS = (0, 3)

    @pytest.mark.parametrize("batched", [SerialEnv, ParallelEnv])
    @pytest.mark.parametrize("inside", [False, True], ids=["around", "inside"])
    def test_with_the_transform_around_the_workers_or_inside(self, batched, inside):
        base, start = chain(start=self.STARTS, batch=[2])
        make = partial(ChainEnv, 6, reward_per_step=-0.25)
        envs = batched(2, macro_chain) if inside else macro(batched(2, make))
        try:
            check_env_specs(envs)
            for options in ([RIGHT, RIGHT], [RIGHT, LEFT]):
                td = envs.reset()
                td["state"] = start["state"].clone()
                td["option"] = torch.tensor(options)
                expected = by_hand(base, td.select("state", "option"), skill_is_action())
                assert_close(envs.step(td.clone())["next"], expected)
            for kwargs in ({}, {"break_when_all_done": True}):
                envs.set_seed(0)
                td = envs.rollout(15, break_when_any_done=False, **kwargs)
                check_macro_rollout(base, td, skill_is_action(), **kwargs)
        finally:
            envs.close()


def balancing():
    """A CartPole worker: skill 0 pushes left, skill 1 pushes towards where the pole falls."""

    def push(observation, skill):
        right = (observation[..., 2] + observation[..., 3] > 0) & (skill == 1)
        return torch.stack([~right, right], -1).to(torch.int64)

    return TensorDictModule(push, ["observation", "skill"], ["action"])


class TestGymEnv:
    """CartPole cannot be batched or set to a state: the transform follows it as it goes."""

    @pytest.mark.parametrize("max_steps", [1, 5, 500])
    def test_macro_steps_are_those_of_a_loop(self, max_steps):
        env, base = macro(GymEnv("CartPole-v1"), balancing(), max_steps=max_steps), None
        base = GymEnv("CartPole-v1")
        for e in (env, base):
            e.set_seed(3)
        td, root = env.reset(), base.reset()
        for option in (1, 1, 0, 1, 0, 0):
            after = step_next(env, td, option)
            expected, _ = option_by_hand(
                base, root.set("option", torch.tensor(option)), balancing(), max_steps
            )
            assert_close(after, expected)
            if after["done"]:
                break
            td, root = after, expected
        assert max_steps == 1 or after["done"]


def check_macro_rollout(base, td, worker, max_steps=4, break_when_all_done=False, **_):
    """Every macro-step of a rollout is that of a loop from its root; roots follow each other."""
    finished = torch.zeros(td.shape[:-1], dtype=torch.bool)
    assert td["next", "done"].any()
    for t in range(td.shape[-1]):
        now = td[..., t]
        expected = by_hand(base, now.select("state", "option"), worker, max_steps)
        assert_close(now["next"][~finished], expected[~finished])
        done = now["next", "done"].squeeze(-1)
        if break_when_all_done:
            finished |= done
            assert finished.all() == (t == td.shape[-1] - 1)
        if t + 1 < td.shape[-1]:
            state = torch.where(done, 0, now["next", "state"])
            assert torch.equal(td[..., t + 1]["state"][~finished], state[~finished])


class TestRollouts:
    @pytest.mark.parametrize("batch", BATCHES)
    @pytest.mark.parametrize("until_all", [False, True])
    def test_episodes_are_reset_and_continue_or_wait_for_all(self, batch, until_all):
        base, td = chain(batch=batch)
        env = macro(base)
        if until_all:
            td["state"] = torch.randint(5, batch)
        td = env.rollout(
            100 if until_all else 20,
            tensordict=env.reset(td, set_state=True),
            auto_reset=False,
            break_when_any_done=False,
            break_when_all_done=until_all,
        )
        assert until_all or td.shape == (*batch, 20)
        check_macro_rollout(base, td, skill_is_action(), break_when_all_done=until_all)


class TestOtherTransforms:
    def test_those_after_it_see_macro_steps(self):
        env = TransformedEnv(
            ChainEnv(6, reward_per_step=-0.25),
            Compose(OptionTransform(skill_is_action(), 2, 3, GAMMA), StepCounter(), RewardSum()),
        )
        check_env_specs(env)
        right = lambda td: td.set("option", torch.full(td.shape, RIGHT))  # noqa: E731
        td = env.rollout(10, right)
        assert td["next", "step_count"].flatten().tolist() == [1, 2]
        assert td["next", "duration"].flatten().tolist() == [3, 2]
        reward = td["next", "reward"]
        torch.testing.assert_close(td["next", "episode_reward"], reward.cumsum(0))

    def test_a_transform_put_in_front_later_is_seen_too(self):
        env = macro(ChainEnv(6), max_steps=3)
        env.rollout(2)
        env.insert_transform(0, RewardScaling(0.0, 10.0))
        td = env.reset().set("state", torch.tensor(3))
        assert step_next(env, td, RIGHT)["reward"].item() == pytest.approx(9)


KEYS = ["state", "action", ("next", "state"), ("next", "reward"), ("next", "done")]


def test_what_the_worker_reads_is_part_of_the_macro_state_so_that_search_can_start_there():
    # "observation" is a read-out of Waterworld, not of its state; a stored node needs it all the
    # same, since the first base step of an option is the worker's.
    towards_target = TensorDictModule(
        lambda seen, skill: torch.where(skill == 0, skill, 3 * (seen[..., 2] > seen[..., 0])),
        ["observation", "skill"],
        ["action"],
    )
    maze, _, _ = maze_from_text("....\n####")
    base = WaterworldMazeEnv(maze[None], seed=0)
    env = TransformedEnv(base, OptionTransform(towards_target, 2, 30))
    assert "observation" in env.full_state_spec.keys()
    assert "observation" not in base.full_state_spec.keys()
    start = base.make_state(0, (0.5, 0.5), (3.5, 0.5))
    plan = MCTSPlanner(env, novelty=RadiusNovelty("position", 0.4)).plan(start)
    assert plan.found
    assert (plan.options[: int(plan.lengths)] == 1).all()


def check_trajectories(base, td, after, worker, max_steps, keys=KEYS):
    """The blocks of a macro-step hold the base steps of a loop, and zeros after them."""
    trajectory = after["trajectory"].reshape(-1, max_steps)
    roots = td.reshape(-1)
    for i in range(roots.shape[0]):
        _, steps = option_by_hand(base, roots[i], worker, max_steps)
        assert trajectory["mask"][i].tolist() == [t < len(steps) for t in range(max_steps)]
        for key in keys:
            values = torch.stack([step[key] for step in steps])
            torch.testing.assert_close(trajectory[key][i, : len(steps)], values)
            assert not trajectory[key][i, len(steps) :].any()


class TestTrajectories:
    @pytest.mark.parametrize(
        ("make", "batch"),
        [
            *((partial(ChainEnv, 6), batch) for batch in BATCHES),
            (partial(ChainEnv, 6, batch_size=[4]), [4]),
            (partial(ChainEnv, 6, batch_size=[2, 3]), [2, 3]),
            (lambda: SerialEnv(2, partial(ChainEnv, 6)), [2]),
        ],
    )
    def test_they_hold_the_base_steps(self, make, batch):
        env = macro(make(), trajectory_keys=KEYS)
        check_env_specs(env)
        td = env.reset() if env.batch_size else env.reset(TensorDict(batch_size=batch))
        assert not td["trajectory", "mask"].any()
        td["state"] = torch.randint(5, batch)
        td["option"] = torch.randint(2, batch)
        after = env.step(td.clone())["next"]
        assert after["trajectory"].shape == (*batch, 4)
        check_trajectories(ChainEnv(6), td.select("state", "option"), after, skill_is_action(), 4)

    @pytest.mark.parametrize(
        ("keys", "message"),
        [
            (["speed"], r"trajectory_keys names 'speed'.*'state'"),
            ([], r"trajectory_keys is empty.*None"),
        ],
    )
    def test_keys_that_record_nothing_are_refused(self, keys, message):
        with pytest.raises(ValueError, match=message):
            macro(ChainEnv(6), trajectory_keys=keys)


class TestOwnership:
    def test_the_workers_mode_parameters_and_gradients_are_its_owners(self):
        worker = TensorDictModule(Hidden(), ["skill"], ["action"])
        transform = OptionTransform(worker, 2, 3)
        env = TransformedEnv(ChainEnv(6), transform)
        env.rollout(2)
        assert all(module.training for module in worker.modules())
        worker.eval()
        env.train()
        assert not any(module.training for module in worker.modules())
        assert not list(env.parameters())
        assert not env.state_dict()
        assert transform.worker is worker

    def test_a_clone_serves_a_second_env_with_the_same_worker(self):
        transform = OptionTransform(skill_is_action(), 2, 4, GAMMA)
        first = TransformedEnv(ChainEnv(6), transform)
        first.rollout(2)
        second = TransformedEnv(ChainEnv(4), transform.clone())
        assert second.transform.worker is transform.worker
        for env, end in ((first, 5), (second, 3)):
            td = env.rollout(5, lambda td: td.set("option", torch.tensor(RIGHT)))
            assert td["next", "state"][-1] == end

    def test_the_callers_tensordict_gains_next_only(self):
        env = macro(ChainEnv(6))
        td = env.reset().set("option", torch.tensor(RIGHT))
        before = set(td.keys())
        env.step(td)
        assert set(td.keys()) == before | {"next"}
        assert "skill" not in td["next"].keys()


def broken(env_or_td, message, error=ValueError, *, call=None):
    """Assert that the call raises, and leaves the tensordict as it was."""
    env, td = env_or_td
    before = td.clone()
    with pytest.raises(error, match=message):
        (call or env.step)(td)
    assert set(td.keys(True, True)) == set(before.keys(True, True))
    assert (td == before).all()


class TestBadInput:
    @pytest.mark.parametrize("option", [2, -1, 99])
    @pytest.mark.parametrize("batch", BATCHES)
    def test_an_option_out_of_range_is_refused(self, batch, option):
        base, td = chain(batch=batch)
        options = torch.zeros(batch, dtype=torch.int64)
        options.view(-1)[-1] = option
        message = f"Option {option} does not exist: options are 0 to 1.*larger num_options"
        broken((macro(base), td.set("option", options)), message)

    @pytest.mark.parametrize(
        ("option", "got"), [([0.0, 1.0], r"float32 \[2\]"), ([[0], [1]], r"int64 \[2, 1\]")]
    )
    def test_an_option_of_the_wrong_form_is_refused(self, option, got):
        base, td = chain(batch=[2])
        message = rf"must be int64 \[2\]; got torch.{got}.*rand_action"
        broken((macro(base), td.set("option", torch.tensor(option))), message)

    def test_a_missing_option_is_refused(self):
        base, td = chain()
        broken((macro(base), td), "no option under 'option'.*rand_action", KeyError)

    @pytest.mark.parametrize(
        ("worker", "message"),
        [
            (
                TensorDictModule(lambda x, z: z, ["speed", "skill"], ["action"]),
                "reads 'speed', which ChainEnv does not have: it has .*'state'.*Change the worker",
            ),
            (
                TensorDictModule(lambda z: z, ["skill"], ["steering"]),
                r"wrote no 'action', the action of ChainEnv. Give it out_keys=\['action'\]",
            ),
            (
                TensorDictModule(lambda z: z.float(), ["skill"], ["action"]),
                r"(?s)wrote 'action' = torch.float32 \[\].*does not fit .*Build the worker from",
            ),
            (
                TensorDictModule(lambda z: z.unsqueeze(-1), ["skill"], ["action"]),
                r"wrote 'action' = torch.int64 \[1\].*does not fit",
            ),
            (
                TensorDictModule(lambda z: z + 2, ["skill"], ["action"]),
                r"torch.int64 \[\] with values up to 2, which does not fit",
            ),
        ],
    )
    def test_a_worker_that_does_not_fit_is_refused_when_attached(self, worker, message):
        with pytest.raises(ValueError, match=message):
            TransformedEnv(ChainEnv(6), Compose(StepCounter(), OptionTransform(worker, 2, 4)))
        env = TransformedEnv(ChainEnv(6))
        with pytest.raises(ValueError, match=message):
            env.append_transform(OptionTransform(worker, 2, 4))

    def test_a_worker_that_fails_midway_leaves_nothing_behind(self):
        def fail_later(state, skill):
            if (state == 3).any():
                raise RuntimeError("the worker is lost")
            return skill

        base, td = chain(batch=[2])
        env = macro(base, TensorDictModule(fail_later, ["state", "skill"], ["action"]))
        broken((env, td.set("option", torch.tensor([RIGHT, LEFT]))), "lost", RuntimeError)

    def test_several_rewards_are_refused(self):
        env = ChainEnv(6)
        env.reward_spec = Composite(reward=Unbounded((1,)), cost=Unbounded((1,)))
        with pytest.raises(ValueError, match="sums one reward; ChainEnv has the rewards .*cost"):
            macro(env)

"""Options that end by themselves: counts by hand, losses in closed form, a corridor learned."""

from __future__ import annotations

import pytest
import torch
from learned_termination import HindsightTransitions, MazeView
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import Compose, GymEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.objectives import SoftUpdate

from torchrl_hmcts.envs import maze_from_text
from torchrl_hmcts.modules import (
    LearnedTermination,
    StallTermination,
    TerminationNetwork,
)
from torchrl_hmcts.objectives import IntraOptionQLoss, OptionTerminationLoss
from torchrl_hmcts.planners import MCTSPlanner, SearchBudget, Transpositions
from torchrl_hmcts.testing import ChainEnv, TableEnv
from torchrl_hmcts.transforms import OptionTransform, StallTransform

LEFT, RIGHT = 0, 1


def skill_is_action():
    return TensorDictModule(lambda skill: skill.clone(), ["skill"], ["action"])


def stall_chain(**kwargs):
    return TransformedEnv(ChainEnv(6, **kwargs), StallTransform("state", 0.5))


def stall_options(base, num_steps=2, max_steps=20, key="state", tolerance=0.5, **kwargs):
    stall = StallTransform(key, tolerance)
    options = OptionTransform(
        skill_is_action(), 2, max_steps, 0.9, termination=StallTermination(num_steps), **kwargs
    )
    return TransformedEnv(base, Compose(stall, options))


def walk(env, actions, td=None):
    """Carry out actions one after the other; the counts that the env wrote."""
    td = env.reset() if td is None else td
    counts = []
    for action in actions:
        td = env.step(td.set("action", torch.as_tensor(action)))["next"]
        counts.append(td["stalled_steps"].flatten().tolist())
    return counts


class TestStallTransform:
    def test_it_counts_steps_without_movement_and_starts_again_after_one(self):
        """A chain stays where it is at its left end only."""
        actions = [LEFT, LEFT, RIGHT, LEFT, LEFT, LEFT]
        assert walk(stall_chain(), actions) == [[1], [2], [0], [0], [1], [2]]

    @pytest.mark.parametrize(("tolerance", "counts"), [(4.9, 0), (5.1, 1), (0.0, 0)])
    def test_the_distance_is_euclidean_over_all_but_the_batch(self, tolerance, counts):
        stall = StallTransform("place", tolerance)
        before = TensorDict(place=torch.zeros(2, 2, 1), batch_size=[2])
        after = TensorDict(place=torch.tensor([[3.0], [4.0]]).expand(2, 2, 1), batch_size=[2])
        assert stall._step(before, after)["stalled_steps"].tolist() == [[counts], [counts]]

    def test_without_movement_a_tolerance_of_zero_counts_nothing(self):
        same = TensorDict(place=torch.ones(2), batch_size=[2])
        out = StallTransform("place", 0.0)._step(same, same.clone())
        assert out["stalled_steps"].tolist() == [[0], [0]]

    def test_a_partial_reset_sets_the_counts_of_its_elements_to_zero(self):
        env = stall_chain(batch_size=[3])
        td = env.step(env.reset().set("action", torch.tensor([LEFT] * 3)))["next"]
        td.set("_reset", torch.tensor([[True], [False], [True]]))
        td = env.reset(td, set_state=False)
        assert td["stalled_steps"].flatten().tolist() == [0, 1, 0]
        assert walk(env, [[LEFT] * 3], td) == [[1, 2, 1]]

    def test_a_state_without_a_count_begins_at_zero(self):
        env = stall_chain()
        td = TensorDict(state=torch.tensor([0, 2]), batch_size=[2])
        assert walk(env, [[LEFT, LEFT]] * 2, td) == [[1, 0], [2, 0]]

    def test_an_observation_that_is_no_state_becomes_one_for_planners(self):
        env = TransformedEnv(GymEnv("CartPole-v1"), StallTransform("observation"))
        assert "observation" in env.state_spec.keys()
        assert "stalled_steps" not in env.state_spec.keys()

    def test_what_it_cannot_do_is_refused(self):
        with pytest.raises(KeyError, match="'place', which the env before it does not write"):
            check_env_specs(TransformedEnv(ChainEnv(6), StallTransform("place")))
        with pytest.raises(KeyError, match='"x" not found'):
            StallTransform("x")._step(TensorDict(), TensorDict(x=torch.zeros(1)))


class TestStallTermination:
    def test_an_option_ends_when_it_has_been_stuck_long_enough(self):
        """From state 3 to the left: three steps, then two in which nothing changes."""
        env = stall_options(ChainEnv(6))
        td = env.reset(TensorDict(batch_size=[3])).set("state", torch.tensor([3, 0, 1]))
        after = env.step(td.set("option", torch.tensor([LEFT, LEFT, RIGHT])))["next"]
        assert after["duration"].flatten().tolist() == [5, 2, 4]
        assert after["stalled_steps"].flatten().tolist() == [2, 2, 0]
        assert after["done"].flatten().tolist() == [False, False, True]

    def test_what_stood_still_before_the_option_does_not_count(self):
        env = stall_options(ChainEnv(6), num_steps=3)
        td = env.reset().set("option", torch.tensor(LEFT))
        for _ in range(3):
            td = env.step(td)["next"]
            assert td["duration"].item() == 3
            td = td.set("option", torch.tensor(LEFT))
        assert td["stalled_steps"].item() == 9

    @pytest.mark.parametrize("length", [4, 7])
    def test_plans_are_the_same_whatever_count_the_root_has(self, length):
        env = stall_options(ChainEnv(length), num_steps=1, max_steps=2)
        root = env.reset()
        stuck = root.clone().set("stalled_steps", torch.tensor([7]))
        budget = SearchBudget(expansions=20, until_plan=False)
        trees = []
        for td in (root, stuck, root.exclude("stalled_steps")):
            search = MCTSPlanner(env, budget=budget, transpositions=Transpositions("state"))
            trees.append(search.search(td).tree)
        for tree in trees[1:]:
            assert (tree.nodes == trees[0].nodes).all()
            assert (tree.edges == trees[0].edges).all()
        assert "stalled_steps" not in trees[0].states.keys()

    def test_a_missing_count_is_named_when_the_env_is_made(self):
        with pytest.raises(ValueError, match="StallTermination.*reads 'stalled_steps'"):
            TransformedEnv(
                ChainEnv(6),
                OptionTransform(skill_is_action(), 2, 9, termination=StallTermination(2)),
            )


class Logits(nn.Module):
    """One logit for each state and option, as a network whose output is known."""

    def __init__(self, num_states, num_options, value=0.0):
        super().__init__()
        self.entries = nn.Parameter(torch.full((num_states, num_options), value))

    def forward(self, state, skill):
        return self.entries[state, skill].unsqueeze(-1)


class Values(nn.Module):
    """A value for each state and option."""

    def __init__(self, entries):
        super().__init__()
        self.entries = nn.Parameter(torch.as_tensor(entries))

    def forward(self, state):
        return self.entries[state]


def termination_module(num_states, num_options, value=0.0):
    network = Logits(num_states, num_options, value)
    return TensorDictModule(network, ["state", "skill"], ["termination_logits"])


def value_module(entries):
    return TensorDictModule(Values(entries), ["state"], ["action_value"])


def transitions(rows, dtype=torch.float32):
    """Rows of state, option, reward, next state, terminated."""
    state, skill, reward, after, terminated = zip(*rows, strict=True)
    size = [len(rows)]
    following = {
        "state": torch.tensor(after),
        "reward": torch.tensor(reward, dtype=dtype).unsqueeze(-1),
        "terminated": torch.tensor(terminated).unsqueeze(-1),
        "duration": torch.ones(*size, 1, dtype=torch.int64),
    }
    return TensorDict(
        {
            "state": torch.tensor(state),
            "skill": torch.tensor(skill),
            "next": TensorDict(following, batch_size=size),
        },
        batch_size=size,
    )


class TestLearnedTermination:
    def td(self, n=1000, duration=5):
        return TensorDict(
            state=torch.zeros(n, dtype=torch.int64),
            skill=torch.zeros(n, dtype=torch.int64),
            duration=torch.full((n, 1), duration),
            batch_size=[n],
        )

    def test_deterministic_it_ends_where_the_probability_is_at_least_a_half(self):
        network = termination_module(3, 2)
        network.module.entries.data = torch.tensor([[-1.0, 1.0], [0.1, -0.1], [0.0, -3.0]])
        td = self.td(6)
        td["state"] = torch.tensor([0, 0, 1, 1, 2, 2])
        td["skill"] = torch.tensor([0, 1, 0, 1, 0, 1])
        ends = LearnedTermination(network)(td)
        assert ends.tolist() == [False, True, True, False, True, False]

    def test_sampled_it_ends_as_often_as_the_network_says(self):
        odds = torch.tensor(0.3).logit().item()
        termination = LearnedTermination(termination_module(1, 1, odds), deterministic=False)
        assert termination(self.td(20_000)).float().mean().item() == pytest.approx(0.3, abs=0.01)

    def test_the_generator_alone_decides_the_samples(self):
        network = termination_module(1, 1)

        def draw(seed, noise):
            torch.manual_seed(noise)
            generator = torch.Generator().manual_seed(seed)
            return LearnedTermination(network, deterministic=False, generator=generator)(self.td())

        assert torch.equal(draw(0, 0), draw(0, 1))
        assert not torch.equal(draw(0, 0), draw(1, 0))

    def test_between_its_questions_nothing_ends(self):
        termination = LearnedTermination(termination_module(1, 1, 5.0), every=3)
        ends = [bool(termination(self.td(1, taken))) for taken in range(1, 8)]
        assert ends == [False, False, True, False, False, True, False]

    def test_in_an_option_it_sees_state_and_option(self):
        """Option RIGHT ends in state 3 only, option LEFT nowhere."""
        network = termination_module(6, 2, -1.0)
        network.module.entries.data[3, RIGHT] = 1.0
        options = OptionTransform(
            skill_is_action(), 2, 9, 0.9, termination=LearnedTermination(network)
        )
        env = TransformedEnv(ChainEnv(6), options)
        td = env.reset(TensorDict(batch_size=[3])).set("state", torch.tensor([0, 4, 3]))
        after = env.step(td.set("option", torch.tensor([RIGHT, LEFT, RIGHT])))["next"]
        assert after["state"].tolist() == [3, 0, 5]
        assert after["duration"].flatten().tolist() == [3, 9, 2]
        assert not list(env.parameters())  # the network is not the env's

    def test_the_network_starts_near_its_initial_probability(self):
        network = TerminationNetwork(2, 4, in_keys=["x"], initial_probability=0.9)
        td = TensorDict(x=torch.zeros(4, 2), skill=torch.arange(4), batch_size=[4])
        probability = network(td)["termination_logits"].sigmoid()
        assert probability.shape == (4, 1)
        assert (probability > 0.8).all()


class ThreeStates:
    r"""Option PAST goes 0 -> 1 -> 0 and never arrives; GOAL goes 1 -> 2, where the reward is 1.

    PAST ends in state 1 with probability b. From state 0 its value is
    J = gamma (b + (1 - b) gamma J), in state 1 it is gamma J, and that of GOAL there 1.
    """

    GAMMA, PAST, GOAL = 0.9, 0, 1

    def value(self, b):
        return self.GAMMA * b / (1 - self.GAMMA**2 * (1 - b))

    def values(self, b):
        past = self.value(b)
        wait = (
            self.GAMMA * 0.5 * past / (1 - self.GAMMA * 0.5)
        )  # GOAL in state 0 ends half the time
        return [
            [past, wait],
            [self.GAMMA * past, 1.0],
            [7.0, 7.0],
        ]  # of a terminal state: no matter


class TestOptionTerminationLoss(ThreeStates):
    def make(self, b=0.3, dtype=torch.float64, **kwargs):
        network = termination_module(3, 2).to(dtype)
        network.module.entries.data[1, self.PAST] = torch.tensor(b, dtype=dtype).logit()
        values = value_module(torch.tensor(self.values(b), dtype=dtype))
        return OptionTerminationLoss(network, values, **kwargs), network, values

    def arrival(self):
        """In state 1 under PAST."""
        return transitions([(0, self.PAST, 0.0, 1, False)], torch.float64)

    def test_it_is_the_probability_times_advantage_and_cost(self):
        loss, *_ = self.make(b=0.3, deliberation_cost=0.25)
        out = loss(self.arrival())
        advantage = self.GAMMA * self.value(0.3) - 1.0
        assert out["option_advantage"].item() == pytest.approx(advantage)
        assert out["termination_probability"].item() == pytest.approx(0.3)
        assert out["loss_termination"].item() == pytest.approx(0.3 * (advantage + 0.25))

    @pytest.mark.parametrize("b", [0.05, 0.3, 0.8])
    def test_its_gradient_is_that_of_the_return(self, b):
        """Theorem 2: the return's derivative is minus the loss's, times the discounted arrivals."""
        loss, _, _ = self.make(b)
        loss(self.arrival())["loss_termination"].backward()
        gradient = loss.termination_network_params["module", "entries"].grad[1, self.PAST].item()
        arrivals = self.GAMMA / (1 - self.GAMMA**2 * (1 - b))
        logit, step = torch.tensor(b, dtype=torch.float64).logit(), 1e-5
        ahead, behind = (self.value((logit + d).sigmoid().item()) for d in (step, -step))
        assert -arrivals * gradient == pytest.approx((ahead - behind) / (2 * step), rel=1e-6)

    def test_descent_ends_options_where_another_is_better_and_not_where_they_are_best(self):
        loss, network, _ = self.make(0.5, deliberation_cost=0.1)
        rows = [(0, self.PAST, 0.0, 1, False), (1, self.PAST, 0.0, 0, False)]
        loss(transitions(rows, torch.float64))["loss_termination"].backward()
        gradient = loss.termination_network_params["module", "entries"].grad
        assert gradient[1, self.PAST] < 0  # GOAL is better here: up goes the logit
        assert gradient[0, self.PAST] > 0  # PAST is the best here: down, by the cost alone
        assert gradient[0, self.PAST].item() == pytest.approx(0.5 * 0.25 * 0.1)  # mean of two rows

    def test_after_the_end_of_an_episode_nothing_is_learned(self):
        loss, *_ = self.make(deliberation_cost=0.3)
        out = loss(transitions([(1, self.GOAL, 1.0, 2, True)], torch.float64))
        assert out["loss_termination"].item() == 0.0

    def test_values_of_the_data_serve_as_well(self):
        loss, network, values = self.make()
        td = self.arrival()
        expected = loss(td)["loss_termination"]
        td["next", "action_value"] = values.module.entries.detach()[[1]]
        actual = OptionTerminationLoss(network)(td)["loss_termination"]
        assert actual.item() == pytest.approx(expected.item())

    def test_the_value_of_a_policy_is_a_mean(self):
        policy = lambda td: torch.tensor([[0.25, 0.75]], dtype=torch.float64)  # noqa: E731
        loss, *_ = self.make(0.3, option_policy=policy)
        past = self.GAMMA * self.value(0.3)
        expected = past - (0.25 * past + 0.75)
        assert loss.advantage(self.arrival()).item() == pytest.approx(expected)

    def test_what_makes_no_sense_is_refused(self):
        loss, *_ = self.make()
        td = self.arrival()
        td["skill"] = nn.functional.one_hot(td["skill"], 2)
        with pytest.raises((ValueError, IndexError)):
            loss.advantage(td)


class TestIntraOptionQLoss(ThreeStates):
    def rows(self):
        return transitions(
            [
                (0, self.PAST, 0.0, 1, False),
                (1, self.PAST, 0.0, 0, False),
                (1, self.GOAL, 1.0, 2, True),
                (0, self.GOAL, 0.0, 0, False),
            ]
        )

    def make(self, b=0.3, entries=None, **kwargs):
        network = termination_module(3, 2)
        network.module.entries.data[1, self.PAST] = torch.tensor(b).logit()
        values = value_module(self.values(b) if entries is None else entries)
        kwargs.setdefault("delay_value", False)
        return IntraOptionQLoss(values, network, gamma=self.GAMMA, **kwargs), values, network

    @pytest.mark.parametrize("b", [0.05, 0.3, 1.0 - 1e-6])
    def test_the_values_in_closed_form_are_its_minimum(self, b):
        loss, *_ = self.make(b, reduction="none")
        assert loss(self.rows())["td_error"].abs().max() < 1e-6

    def test_learning_finds_them(self):
        loss, *_ = self.make(0.3, entries=torch.zeros(3, 2), delay_value=True)
        updater = SoftUpdate(loss, tau=0.5)
        optimizer = torch.optim.SGD(loss.parameters(), lr=0.5)
        for _ in range(300):
            optimizer.zero_grad()
            loss(self.rows())["loss_qvalue"].backward()
            optimizer.step()
            updater.step()
        learned = loss.qvalue_network_params["module", "entries"][:2]
        torch.testing.assert_close(learned, torch.tensor(self.values(0.3)[:2]), atol=1e-3, rtol=0)

    def test_pieces_of_several_steps_are_discounted_by_their_duration(self):
        """0 -> 1 -> 0 under PAST, in one piece, where it never ends in between."""
        loss, values, _ = self.make(0.0, entries=[[0.5, 0.1], [0.2, 1.0], [0.0, 0.0]])
        td = transitions([(0, self.PAST, 0.0, 0, False)])
        td["next", "duration"] = torch.tensor([[2]])
        assert loss.target(td).item() == pytest.approx(0.9**2 * 0.5)

    def test_options_that_always_end_are_q_learning(self):
        values = value_module([[0.5, 0.1], [0.2, 1.0], [0.0, 0.0]])
        loss = IntraOptionQLoss(values, gamma=0.9, delay_value=False)
        expected = torch.tensor([0.9 * 1.0, 0.9 * 0.5, 1.0, 0.9 * 0.5])
        torch.testing.assert_close(loss.target(self.rows()), expected)


class TestLearningWhereToEnd:
    """A corridor 0 .. 4 with a door in the middle: up from state 2 lies the goal, state 5.

    Option AHEAD walks on to the dead end: without a termination it never ends at the door.
    """

    AHEAD, UP = 0, 1

    def corridor(self):
        ahead = {(s, self.AHEAD): (min(s + 1, 4), 0.0, 1) for s in range(5)}
        up = {(s, self.UP): (s, 0.0, 1) for s in range(5)}
        return TableEnv({**ahead, **up, (2, self.UP): (5, 1.0, 1)}, terminal=[5])

    def test_an_option_learns_to_end_at_the_door(self):
        rows = [
            (s, o, after.item(), env_reward, terminal)
            for s in range(5)
            for o in (self.AHEAD, self.UP)
            for after, env_reward, terminal in [self.step(s, o)]
        ]
        td = transitions([(s, o, r, after, end) for s, o, after, r, end in rows])
        termination = termination_module(6, 2)
        values = value_module(torch.zeros(6, 2))
        value_loss = IntraOptionQLoss(values, termination, gamma=0.9, delay_value=False)
        loss = OptionTerminationLoss(termination, values, deliberation_cost=0.02)
        optimizer = torch.optim.Adam([*value_loss.parameters(), *loss.parameters()], lr=0.05)
        for _ in range(300):
            optimizer.zero_grad()
            (value_loss(td)["loss_qvalue"] + loss(td)["loss_termination"]).backward()
            optimizer.step()

        def ahead(end):
            options = OptionTransform(skill_is_action(), 2, 10, 0.9, termination=end)
            env = TransformedEnv(self.corridor(), options)
            first = env.step(env.reset().set("option", torch.tensor(self.AHEAD)))["next"]
            second = env.step(first.clone().set("option", torch.tensor(self.UP)))["next"]
            return first["state"].item(), second["reward"].item()

        assert ahead(None) == (4, 0.0)
        assert ahead(LearnedTermination(termination)) == (2, 1.0)

    def step(self, state, option):
        env = self.corridor()
        td = env.reset().set("state", torch.tensor(state)).set("action", torch.tensor(option))
        after = env.step(td)["next"]
        return after["state"], after["reward"].item(), after["terminated"].item()


class TestHindsight:
    """Six base steps of one tile each to the right, in two options of three."""

    def data(self):
        x = torch.arange(6.0) + 0.5
        place = torch.stack((x, torch.full_like(x, 0.5)), -1)[None]
        size = [1, 6]
        state = {"velocity": torch.zeros(1, 6, 2), "maze_index": torch.zeros(size).long()}
        after = {"position": place + torch.tensor([1.0, 0.0]), **state}
        done = torch.zeros(1, 6, 1, dtype=torch.bool)
        return TensorDict(
            {
                **state,
                "position": place,
                "skill": torch.tensor([[0, 0, 0, 1, 1, 1]]),
                "skill_step": torch.tensor([[0, 1, 2, 0, 1, 2]]).unsqueeze(-1),
                "next": TensorDict({**after, "done": done}, batch_size=size),
            },
            batch_size=size,
        )

    def view(self):
        return MazeView(maze_from_text(".......")[0][None], reach=1)

    def test_a_view_holds_place_in_the_tile_velocity_and_walls_around(self):
        maze, _, _ = maze_from_text("..#\n...")
        td = TensorDict(
            position=torch.tensor([[1.25, 0.5]]),
            velocity=torch.tensor([[1.0, -2.0]]),
            maze_index=torch.tensor([0]),
            batch_size=[1],
        )
        view = MazeView(maze[None], reach=1)(td)["view"][0]
        assert view[:4].tolist() == [-0.5, 0.0, 1.0, -2.0]
        assert view[4:].reshape(3, 3).tolist() == [[1, 1, 1], [0, 0, 1], [0, 0, 0]]

    def test_pieces_lie_within_an_option(self):
        transitions = HindsightTransitions(self.data(), self.view(), touch=0.5, every=2)
        assert transitions.pieces[:, 1].tolist() == [0, 1, 3, 4]

    def test_rewards_are_those_of_the_target_by_hand(self):
        transitions = HindsightTransitions(
            self.data(), self.view(), touch=0.5, every=2, gamma=0.9, seed=1
        )
        td = transitions.sample(500)
        ahead = td["offset"][:, 0]  # tiles, a base step each
        assert (ahead != 0).all()  # none begins at its target
        expected = torch.where(ahead == 1, 1.0, torch.where(ahead == 2, 0.9, 0.0))
        torch.testing.assert_close(td["next", "reward"].squeeze(-1), expected)
        assert torch.equal(td["next", "terminated"].squeeze(-1), (ahead == 1) | (ahead == 2))
        torch.testing.assert_close(td["next", "offset"][:, 0], ahead - 2)
        assert {1.0, 2.0, 4.0, -2.0} <= set(ahead.tolist())

    def test_data_without_a_whole_piece_are_refused(self):
        with pytest.raises(ValueError, match="no piece of an option of every=4"):
            HindsightTransitions(self.data(), self.view(), touch=0.5, every=4)

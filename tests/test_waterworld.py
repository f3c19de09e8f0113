"""WaterworldMazeEnv: physics in closed form, states, TorchRL's contracts, bad input."""

from __future__ import annotations

import math
from functools import lru_cache, partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from torchrl_hmcts.envs import WaterworldMazeEnv, free_tiles, maze_from_text, maze_pool
from torchrl_hmcts.envs.mazes.rendering import FREE_COLOR, PLAYER_COLOR, TARGET_COLOR, WALL_COLOR

UP, DOWN, LEFT, RIGHT = range(4)
STATE_KEYS = ["position", "velocity", "target", "maze_index", "step_count"]
DT, THRUST = WaterworldMazeEnv.TIME_STEP, WaterworldMazeEnv.THRUST
KEPT = WaterworldMazeEnv.DAMPING**DT  # share of its velocity that a disc keeps in a step
RADIUS = WaterworldMazeEnv.PLAYER_RADIUS
ROOM = "\n".join(["." * 9] * 9)


def make_env(text=ROOM, **kwargs):
    return WaterworldMazeEnv(maze_from_text(text)[0][None], **kwargs)


def far_state(env, position, **kwargs):
    """A state whose target is in the last free tile, out of the way."""
    tile = free_tiles(env.mazes[0])[-1].item()
    return env.make_state(0, position, (tile % env.width + 0.5, tile // env.width + 0.5), **kwargs)


def play(env, td, actions):
    """The ("next") tensordicts of a list of actions."""
    steps = []
    for action in actions:
        action = torch.as_tensor(action).expand(td.shape)
        td = step_mdp(env.step(td.set("action", action)), exclude_reward=False, exclude_done=False)
        steps.append(td)
    return steps


def act(env, td):
    return td.set("action", torch.randint(4, td.shape))


def depth_in_walls(env, td):
    """How deep each disc [n] is in a wall or out of the maze, tiles, comparing with every tile."""
    position = td["position"].double()
    x, y = position.unbind(-1)
    to_border = torch.stack([x, env.width - x, y, env.height - y], -1).amin(-1)
    centers = torch.cartesian_prod(torch.arange(env.height), torch.arange(env.width)).flip(-1) + 0.5
    delta = (position.unsqueeze(-2) - centers).abs() - 0.5  # [n, H * W, 2]
    to_tile = delta.clamp_min(0).norm(dim=-1) + delta.amax(-1).clamp_max(0)
    solid = env.mazes[td["maze_index"]].flatten(-2)
    return RADIUS - to_tile.masked_fill(~solid, torch.inf).amin(-1).minimum(to_border)


class TestMotion:
    @pytest.mark.parametrize(
        ("action", "direction"), [(UP, (0, -1)), (DOWN, (0, 1)), (LEFT, (-1, 0)), (RIGHT, (1, 0))]
    )
    def test_thrust_accelerates_in_its_direction(self, action, direction):
        env = make_env()
        (after,) = play(env, far_state(env, (4.5, 4.5)), [action])
        expected = torch.tensor(direction) * THRUST * DT
        torch.testing.assert_close(after["velocity"], expected, atol=1e-6, rtol=0)

    def test_free_flight_is_the_closed_form(self):
        env = make_env()
        td = far_state(env, (4.5, 4.5), velocity=(-1.5, 0.75))
        directions = torch.tensor([(0.0, -1.0), (0.0, 1.0), (-1.0, 0.0), (1.0, 0.0)])
        for action in torch.randint(4, (25,)):
            (after,) = play(env, td, [action])
            position = td["position"] + td["velocity"] * DT
            velocity = td["velocity"] * KEPT + directions[action] * THRUST * DT
            torch.testing.assert_close(after["position"], position, atol=1e-6, rtol=0)
            torch.testing.assert_close(after["velocity"], velocity, atol=1e-6, rtol=0)
            td = after

    def test_top_speed_is_where_thrust_and_drag_balance(self):
        env = make_env("." * 40)
        td = play(env, far_state(env, (0.5, 0.5)), [RIGHT] * 150)[-1]
        assert td["velocity"][0].item() == pytest.approx(THRUST * DT / (1 - KEPT), abs=1e-4)
        assert td["velocity"][0] < env.MAX_SPEED

    @pytest.mark.parametrize("action", [UP, DOWN, LEFT, RIGHT])
    def test_walls_take_the_speed_into_them_and_leave_the_speed_along_them(self, action):
        """In a corridor one tile wide, thrust into the wall and drift along it, over many tiles."""
        vertical = action in (LEFT, RIGHT)
        env = make_env("#.#\n" * 11 + "#.#" if vertical else "#" * 12 + "\n" + "." * 12)
        along = 1 if vertical else 0
        start = (1.5, 0.5) if vertical else (0.5, 1.5)
        velocity = (0.0, 2.5) if vertical else (2.5, 0.0)
        into_wall = []
        td = far_state(env, start, velocity=velocity)
        for _ in range(40):
            (after,) = play(env, td, [action])
            kept = td["velocity"][along] * KEPT
            assert after["velocity"][along].item() == pytest.approx(kept.item(), abs=1e-6)
            into_wall.append(after["velocity"][1 - along].abs().item())
            td = after
        hit = next(i for i in range(1, 40) if into_wall[i] < into_wall[i - 1])
        assert max(into_wall[hit:]) < 1e-6  # and no bounce ever after
        expected = 1 + RADIUS if action in (UP, LEFT) else 2 - RADIUS
        assert td["position"][1 - along].item() == pytest.approx(expected, abs=1e-4)

    def test_a_disc_goes_round_a_convex_corner(self):
        """Pressed to a pillar and thrust along it, it passes the edge instead of sticking to it."""
        env = make_env("...\n.#.\n...")
        steps = play(env, far_state(env, (0.75, 1.5)), [RIGHT] * 3 + [UP, RIGHT] * 12)
        velocity = 0.0
        for td in steps[3::2]:  # the thrusts upwards
            if td["position"][1] > 1:  # beside the pillar
                velocity = velocity * KEPT - THRUST * DT
                assert td["velocity"].tolist() == pytest.approx([0.0, velocity], abs=1e-5)
            velocity *= KEPT
        assert velocity < -0.5
        td = play(env, td, [RIGHT] * 25)[-1]
        assert td["position"][0] > 1.5
        assert td["position"][1] < 0.751

    def test_no_disc_enters_a_wall_or_leaves_the_maze(self):
        env = WaterworldMazeEnv(maze_pool("all"), seed=0, max_steps=10**6)
        td = env.reset(TensorDict(batch_size=[300]))
        action = torch.randint(4, (300,))
        for step in range(300):
            # Held for about 15 steps: long enough for top speed into any wall.
            action = torch.where(torch.rand(300) < 0.93, action, torch.randint(4, (300,)))
            td = env._step(td.set("action", action))
            if step % 5 == 0:
                assert depth_in_walls(env, td).max() < 1e-3
        assert (td["velocity"].abs() <= env.MAX_SPEED).all()
        assert env.observation_spec["position"].expand(300, 2).is_in(td["position"])

    @settings(max_examples=15)
    @given(st.integers(0, 10**6))
    def test_not_even_at_the_greatest_speed_a_state_may_have(self, seed):
        env, n = pool_env(), 400
        generator = torch.Generator().manual_seed(seed)
        draw = partial(torch.rand, n, 2, generator=generator)
        maze = torch.randint(env.num_mazes, (n,), generator=generator)
        position, limit = draw() * 9, env.MAX_SPEED
        velocity = (draw() * 4 * limit - 2 * limit).clamp(-limit, limit)
        td = TensorDict({"position": position, "maze_index": maze}, batch_size=[n])
        clear = depth_in_walls(env, td) <= 0
        at = position[clear]
        td = env.make_state(maze[clear], at, target=at, velocity=velocity[clear])
        for _ in range(4):
            td = env._step(act(env, td))
            assert depth_in_walls(env, td).max() < 1e-3


@lru_cache
def pool_env():
    return WaterworldMazeEnv(maze_pool("test"), seed=0, max_steps=10**6)


class TestObservation:
    def test_entries_come_in_the_order_of_the_dissertation(self):
        env = make_env("..#\n#..")
        td = env.make_state(0, (0.5, 0.25), (2.5, 1.5))
        expected = [0.5, 0.25, 2.5, 1.5, 2.5, 0.5, 0.5, 1.5]  # player, target, walls row by row
        assert td["observation"].tolist() == expected

    def test_pool_mazes_have_66_entries_of_which_only_the_player_moves(self):
        td = WaterworldMazeEnv(maze_pool("test"), seed=0).rollout(20)
        assert td["observation"].shape == (20, 66)
        assert torch.equal(td["observation"][:, :2], td["position"])
        assert torch.equal(td["observation"][:, 2:4], td["target"])
        assert (td["observation"][:, 2:] == td["observation"][0, 2:]).all()
        maze = maze_pool("test")[td["maze_index"][0]]
        walls = [(c + 0.5, r + 0.5) for r in range(9) for c in range(9) if maze[r, c]]
        assert td["observation"][0, 4:].view(31, 2).tolist() == [list(wall) for wall in walls]

    def test_render_shows_a_blue_player_and_a_green_target(self):
        env = make_env("..#\n...")
        image = env.render(env.make_state(0, (0.5, 1.5), (1.5, 0.5)), tile_pixels=32)

        def pixel(x, y):
            return tuple(image[8 + int(y * 32), 8 + int(x * 32)].tolist())

        assert pixel(0.5, 1.5) == PLAYER_COLOR
        assert pixel(1.5, 0.5) == TARGET_COLOR
        assert pixel(2.5, 0.5) == WALL_COLOR
        assert pixel(2.5, 1.5) == FREE_COLOR
        assert PLAYER_COLOR[2] == max(PLAYER_COLOR)  # blue
        assert TARGET_COLOR[1] == max(TARGET_COLOR)  # green


class TestEnd:
    def test_touching_the_target_ends_the_episode_with_the_only_reward(self):
        env = make_env("......")
        td = env.rollout(
            200,
            policy=lambda td: td.set("action", torch.tensor(RIGHT)),
            tensordict=far_state(env, (0.5, 0.5)),
            auto_reset=False,
        )
        reward = td["next", "reward"].flatten().tolist()
        assert reward == [0.0] * (len(reward) - 1) + [1.0]
        ends = {key: td["next", key].flatten().tolist() for key in ("terminated", "done")}
        assert ends["terminated"] == ends["done"] == [r == 1 for r in reward]
        assert not td["next", "truncated"].any()
        gap = (td["next", "position"] - td["next", "target"]).norm(dim=-1)
        touch = env.PLAYER_RADIUS + env.TARGET_RADIUS
        assert gap[-1] < touch <= gap[-2]

    def test_rewards_count_the_arrivals_of_many_episodes(self):
        env = make_env("..\n..", seed=0, max_steps=60)
        td = env.reset(TensorDict(batch_size=[20]))
        td = env.rollout(
            400, partial(act, env), tensordict=td, auto_reset=False, break_when_any_done=False
        )
        after = td["next"]
        assert after["reward"].sum() > 10
        assert torch.equal(after["reward"] == 1, after["terminated"])
        assert torch.equal(after["truncated"], after["step_count"] == 60)
        assert torch.equal(after["done"], after["terminated"] | after["truncated"])

    def test_the_time_limit_truncates_and_does_not_terminate(self):
        env = make_env(max_steps=3)
        steps = play(env, far_state(env, (0.5, 0.5)), [UP] * 3)
        assert [td["truncated"].item() for td in steps] == [False, False, True]
        assert [td["done"].item() for td in steps] == [False, False, True]
        assert not any(td["terminated"] for td in steps)
        assert [td["step_count"].item() for td in steps] == [1, 2, 3]
        assert not any(td["reward"] for td in steps)

    def test_arrival_at_the_time_limit_is_both(self):
        env = make_env("...", max_steps=1)
        (td,) = play(env, env.make_state(0, (0.5, 0.5), (0.9, 0.5)), [RIGHT])
        assert td["terminated"]
        assert td["truncated"]
        assert td["reward"] == 1


class TestReset:
    def test_player_and_target_are_centres_of_distinct_free_tiles_at_rest(self):
        env = WaterworldMazeEnv(seed=0)
        td = env.reset(TensorDict(batch_size=[20_000]))
        for key in ("position", "target"):
            assert ((td[key] % 1) == 0.5).all()
            tile = td[key].long()
            assert not env.mazes[td["maze_index"], tile[:, 1], tile[:, 0]].any()
        assert (td["position"] != td["target"]).any(-1).all()
        assert not td["velocity"].any()
        assert not td["step_count"].any()
        assert len(td["maze_index"].unique()) > 1990


class TestState:
    def test_states_in_corners_continue_too(self):
        env = make_env("....\n.##.\n....")
        runs = []
        for corner in [(0.5, 0.5), (3.5, 0.5), (0.5, 2.5), (3.5, 2.5)]:
            into = [LEFT if corner[0] < 2 else RIGHT, UP if corner[1] < 1 else DOWN]
            away = [RIGHT if corner[0] < 2 else LEFT, DOWN if corner[1] < 1 else UP]
            actions = into * 15 + away * 5 + into * 10
            td = env.make_state(0, corner, (1.5, 0.5) if corner[1] > 1 else (1.5, 2.5))
            steps = play(env, td, actions)
            before = [td, *steps[:-1]]
            runs += list(zip(before, actions, steps, strict=True))
        other = make_env("....\n.##.\n....")
        for i in torch.randperm(len(runs)).tolist():
            before, action, expected = runs[i]
            state = other.reset(before.select(*STATE_KEYS), set_state=True)
            (after,) = play(other, state, [action])
            assert (after.select(*STATE_KEYS) == expected.select(*STATE_KEYS)).all()

    def test_nan_in_one_element_spoils_no_other(self):
        env = WaterworldMazeEnv(seed=0)
        td = env.reset(TensorDict(batch_size=[3])).set("action", torch.full((3,), DOWN))
        expected = env._step(td)
        spoilt = td.clone()
        spoilt["velocity"][1] = math.nan
        after = env._step(spoilt)
        assert after["position"][1].isnan().all()
        assert not after["terminated"][1]
        assert (after[::2] == expected[::2]).all()

    def test_made_states_have_what_a_reset_has(self):
        env = make_env("..\n#.")
        td = env.make_state(0, [[0.5, 0.5], [1.5, 1.3]], (1.5, 0.5), step_count=[3, 4])
        assert set(td.keys()) == set(env.reset().keys())
        assert td["step_count"].tolist() == [[3], [4]]
        for key, spec in env.observation_spec.items():
            assert spec.expand(td[key].shape).is_in(td[key]), key
        assert (env.reset(td.clone(), set_state=True) == td).all()


class TestBadInput:
    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("position", [math.nan, 0.5], '"position" = nan is not finite.*find the step'),
            ("velocity", [0.0, math.inf], '"velocity" = inf is not finite'),
            ("target", [-math.inf, 0.5], '"target" = -inf is not finite'),
            ("position", [2.5, 0.5], r'"position" .* = \[2.5, 0.5\] is inside a wall of maze 0'),
            ("target", [2.5, 0.5], r'"target" .* = \[2.5, 0.5\] is inside a wall.*free_tiles'),
            ("position", [-0.5, 0.5], r'"position" = \[-0.5, 0.5\] is not inside .* 3 x 2'),
            ("position", [0.5, 2.0], r'"position" = \[0.5, 2.0\] is not inside the maze'),
            ("target", [3.5, 0.5], r'"target" = \[3.5, 0.5\] is not inside the maze'),
            ("velocity", [3.5, 0.0], '"velocity" = 3.5 is out of range: -3 to 3'),
            ("velocity", [0.0, -99.0], '"velocity" = -99.0 is out of range'),
            # A disc that overlaps a face could be pushed out of it on the other side.
            (
                "position",
                [1.875, 0.5],
                r"\[1.875, 0.5\] is 0.125 tiles from a wall of maze 0.*0.25",
            ),
            ("position", [0.0, 0.5], r"\[0.0, 0.5\] is 0 tiles from a wall.*centre"),
            ("position", [0.5, 1.875], r"\[0.5, 1.875\] is 0.125 tiles from a wall"),
            ("position", [1.875, 1.125], r"is 0.177 tiles from a wall"),  # the corner of a wall
        ],
    )
    def test_bad_state_is_refused_with_its_value(self, key, value, message):
        env = make_env("..#\n...")
        td = env.make_state(0, (0.5, 0.5), (1.5, 1.5))
        td[key] = torch.tensor(value)
        with pytest.raises(ValueError, match=message):
            env.reset(td, set_state=True)

    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("maze_index", 1, '"maze_index" = 1 is out of range: 0 to 0'),
            ("maze_index", -1, '"maze_index" = -1 is out of range'),
            ("maze_index", 0.0, '"maze_index" must be torch.int64.*got torch.float32'),
            ("step_count", [-3], '"step_count" = -3 is out of range'),
            ("step_count", [1001], '"step_count" = 1001 is out of range: 0 to 1000'),
            ("step_count", 3, r'"step_count" must be torch.int64 \[1\]; got torch.int64 \[\]'),
            ("position", [0.5], r'"position" must be torch.float32 \[2\]; got .* \[1\]'),
            ("velocity", [0, 0], r'"velocity" must be torch.float32.*got torch.int64.*make_state'),
        ],
    )
    def test_a_state_of_the_wrong_form_is_refused(self, key, value, message):
        env = make_env()
        td = far_state(env, (0.5, 0.5)).set(key, torch.tensor(value))
        with pytest.raises(ValueError, match=message):
            env.reset(td, set_state=True)

    def test_a_disc_that_touches_a_wall_is_a_state(self):
        env = make_env("..#\n...")
        td = env.make_state(0, [[0.25, 0.25], [1.75, 0.5], [2.75, 1.25]], (0.5, 1.5))
        assert td.shape == (3,)

    @pytest.mark.parametrize(
        ("position", "message"),
        [
            (0.5, r"position must be \(x, y\) pairs \[\*B, 2\]; got \[\]"),
            ((0.5, 0.5, 0.0), r"position must be .* got \[3\]"),
        ],
    )
    def test_make_state_refuses_what_is_no_pair(self, position, message):
        env = make_env()
        with pytest.raises(ValueError, match=message):
            far_state(env, position)

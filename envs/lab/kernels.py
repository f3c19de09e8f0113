"""The movement of DeepMind Lab's player on the ground, compiled; units are world units and seconds.

Letters: n players, M mazes, R rows and C columns of cells (row 0 is the south), K apples. All reals
are float32, as in the engine: a velocity is rounded to integers after every frame, so that a
difference in the last digit grows to a unit.
"""

# No annotations: numba infers the types of its arguments.

from __future__ import annotations

import math

import numpy as np

from torchrl_hmcts.compiling import njit

f = np.float32

# Bits of `faces`: on which side of an open cell there is a wall.
WEST, EAST, SOUTH, NORTH = 1, 2, 4, 8

# Columns of `level`, the integers of a state.
SPAWN_HEADING = 0  # heading at the spawn, 65,536 to a full turn
APPLES = 1  # bit k is set while apple k lies there
GOAL_MET = 2  # 1 in the frame in which the goal was picked up
FRAME = 3  # of the episode
LOTTERY = 4  # state of the generator that places the player again
CLOCK, LEAD = 5, 6  # phase of the engine's clock, milliseconds
LEVEL_SIZE = 7

CELL = f(100.0)
_WALL_THICKNESS = f(1.0)
_HALF_WIDTH = f(15.0)  # of the player's box
_GAP = f(0.125)  # kept from every surface
_SPEED = f(320.0)
_ACCELERATION = f(10.0)
_STOP_SPEED = f(100.0)
_OVERCLIP = f(1.001)
_DEGREES_PER_PIXEL_MSEC = 0.11 * 60.0 / 1000.0
_MAX_PITCH = f(16000.0 / 65536.0 * 360.0)
_ZERO, _ONE, _TENTH, _ALMOST_ONE = f(0.0), f(1.0), f(0.1), f(0.99)
_MSEC = f(0.001)

# When the player's centre minus the item's is within these bounds, it is picked up.
_REACH_WEST, _REACH_EAST, _REACH_Y = f(-50.0), f(44.0), f(36.0)


@njit()
def _trace_box(px, py, qx, qy, west, east, south, north):
    """Where the way from p to q enters a box: (fraction, normal x, normal y); fraction 2: never."""
    enter, leave = f(-1.0), _ONE
    nx, ny = _ZERO, _ZERO
    starts_outside = False
    for side in range(4):
        if side == 0:
            d1, d2 = west - px, west - qx
        elif side == 1:
            d1, d2 = px - east, qx - east
        elif side == 2:
            d1, d2 = south - py, south - qy
        else:
            d1, d2 = py - north, qy - north
        if d1 > _ZERO:
            starts_outside = True
            if d2 >= _GAP or d2 >= d1:
                return f(2.0), nx, ny
        elif d2 <= _ZERO:
            continue
        if d1 > d2:
            fraction = max(_ZERO, (d1 - _GAP) / (d1 - d2))
            if fraction > enter:
                enter = fraction
                nx = f(-1.0) if side == 0 else (_ONE if side == 1 else _ZERO)
                ny = f(-1.0) if side == 2 else (_ONE if side == 3 else _ZERO)
        else:
            leave = min(leave, min(_ONE, (d1 + _GAP) / (d1 - d2)))
    if starts_outside and enter > f(-1.0) and enter < leave:
        return enter, nx, ny
    return f(2.0), nx, ny


@njit()
def _trace(px, py, qx, qy, faces):
    """The first wall on the way from p to q: (fraction, normal x, normal y); 1 if there is none."""
    rows, columns = faces.shape
    reach = _HALF_WIDTH + _ONE
    first_column = max(0, int((min(px, qx) - reach) / CELL))
    last_column = min(columns - 1, int((max(px, qx) + reach) / CELL))
    first_row = max(0, int((min(py, qy) - reach) / CELL))
    last_row = min(rows - 1, int((max(py, qy) + reach) / CELL))
    best, nx, ny = _ONE, _ZERO, _ZERO
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            sides = faces[row, column]
            if sides == 0:
                continue
            west = f(column) * CELL - _HALF_WIDTH
            east = f(column) * CELL + CELL + _HALF_WIDTH
            south = f(row) * CELL - _HALF_WIDTH
            north = f(row) * CELL + CELL + _HALF_WIDTH
            thick = _WALL_THICKNESS + _HALF_WIDTH + _HALF_WIDTH
            for bit in (WEST, EAST, SOUTH, NORTH):
                if not sides & bit:
                    continue
                if bit == WEST:
                    hit, hx, hy = _trace_box(px, py, qx, qy, west, west + thick, south, north)
                elif bit == EAST:
                    hit, hx, hy = _trace_box(px, py, qx, qy, east - thick, east, south, north)
                elif bit == SOUTH:
                    hit, hx, hy = _trace_box(px, py, qx, qy, west, east, south, south + thick)
                else:
                    hit, hx, hy = _trace_box(px, py, qx, qy, west, east, north - thick, north)
                if hit < best:
                    best, nx, ny = hit, hx, hy
    return best, nx, ny


@njit()
def _slide(px, py, vx, vy, seconds, faces, planes):
    """Move for a time, sliding along what is in the way; returns position and velocity.

    ``planes`` float32 ``[5, 2]`` is scratch. The floor, the engine's first plane, never changes a
    velocity that has no vertical part, and is left out.
    """
    speed = f(math.sqrt(vx * vx + vy * vy))
    planes[0, 0], planes[0, 1] = vx / speed, vy / speed
    count = 1
    left = seconds
    for _ in range(4):
        qx, qy = px + vx * left, py + vy * left
        fraction, nx, ny = _trace(px, py, qx, qy, faces)
        if fraction >= _ONE:
            return qx, qy, vx, vy
        if fraction > _ZERO:
            px, py = px + fraction * (qx - px), py + fraction * (qy - py)
        left -= left * fraction
        known = False
        for i in range(count):
            if nx * planes[i, 0] + ny * planes[i, 1] > _ALMOST_ONE:
                known = True
                break
        if known:
            vx, vy = vx + nx, vy + ny
            continue
        if count == 4:  # with the floor, five planes
            return px, py, _ZERO, _ZERO
        planes[count, 0], planes[count, 1] = nx, ny
        count += 1
        for i in range(count):
            into = vx * planes[i, 0] + vy * planes[i, 1]
            if into < _TENTH:
                back = into * _OVERCLIP if into < _ZERO else into / _OVERCLIP
                vx, vy = vx - planes[i, 0] * back, vy - planes[i, 1] * back
    return px, py, vx, vy


@njit()
def _heading_units(yaw, spawn_heading):
    """The heading as the engine keeps it: 16 bits of a full turn, from -32,768."""
    units = (int(math.floor(yaw * f(65536.0 / 360.0) + f(0.5))) + spawn_heading) & 65535
    return units - 65536 if units >= 32768 else units


@njit(nogil=True)
def read_out(
    pairs,  # float32 [7, n, 2]: position, velocity and turned are read, the others written
    level,  # int64 [n, 7]
    maze_index,  # int64 [n]
    goal_position,  # float32 [M, 2]
):
    """Write what a player knows of itself and its goal.

    That is its place in cells, its heading (cosine and sine), its velocity forward and to the left
    in shares of the top speed, and the goal in cells, (-1, -1) if there is none.
    """
    for i in range(pairs.shape[1]):
        goal = goal_position[maze_index[i]]
        nowhere = goal[0] < _ZERO
        units = _heading_units(pairs[2, i, 0], level[i, SPAWN_HEADING])
        angle = units * (2.0 * math.pi / 65536.0)
        cosine, sine = f(math.cos(angle)), f(math.sin(angle))
        vx, vy = pairs[1, i, 0] / _SPEED, pairs[1, i, 1] / _SPEED
        pairs[4, i, 0], pairs[4, i, 1] = cosine, sine
        pairs[5, i, 0], pairs[5, i, 1] = vx * cosine + vy * sine, vy * cosine - vx * sine
        for axis in range(2):
            pairs[3, i, axis] = pairs[0, i, axis] / CELL
            pairs[6, i, axis] = f(-1.0) if nowhere else goal[axis] / CELL


@njit(nogil=True)
def advance(
    position,  # float32 [n, 2] x, y
    velocity,  # float32 [n, 2]
    turned,  # float32 [n, 2] degrees of yaw and pitch since the spawn
    level,  # int64 [n, 7]
    maze_index,  # int64 [n]
    action,  # int64 [n, 1] row of `table`, or [n, 7] the engine's own
    pairs,  # float32 [7, n, 2] out: position, velocity, turned, and what `read_out` writes
    new_level,  # int64 [n, 7] out
    reward,  # float32 [n, 1] out
    ends,  # bool [3, n, 1] out: terminated, truncated, done
    table,  # int64 [A, 4] look right, look down (pixels), strafe right, move forward
    num_frames,  # with the same action
    max_frames,  # of an episode
    stops_at_goal,  # whether an episode ends with the goal
    nominal_msec,
    exact_clock,
    friction,
    apple_reward,
    goal_reward,
    faces,  # uint8 [M, R, C]
    apple_position,  # float32 [M, K, 2]
    num_apples,  # int64 [M]
    goal_position,  # float32 [M, 2]
    spawn_position,  # float32 [M, S, 2]
    num_spawns,  # int64 [M]
):
    """Advance every player by ``num_frames`` frames, fewer where its episode ends.

    Returns -1, or the first player whose action or state is unusable; then nothing is to be read.
    """
    planes = np.empty((4, 2), np.float32)
    friction = f(friction)
    apple_reward, goal_reward = f(apple_reward), f(goal_reward)
    turn = f(_DEGREES_PER_PIXEL_MSEC * nominal_msec)
    for i in range(position.shape[0]):
        m = maze_index[i]
        if not _usable(m, position[i], velocity[i], action[i], faces, table):
            return i
        if action.shape[1] == 1:
            a = action[i, 0]
            look, pitch, right, forward = table[a, 0], table[a, 1], table[a, 2], table[a, 3]
        else:
            look, pitch, right, forward = action[i, 0], action[i, 1], action[i, 2], action[i, 3]
        px, py = position[i, 0], position[i, 1]
        vx, vy = velocity[i, 0], velocity[i, 1]
        yaw, down = turned[i, 0], turned[i, 1]
        state = new_level[i]
        state[:] = level[i]
        gain = _ZERO
        for _ in range(num_frames):
            if state[FRAME] >= max_frames or (stops_at_goal and state[GOAL_MET] != 0):
                break
            state[FRAME] += 1
            msec = nominal_msec
            if exact_clock:
                # The engine's frames are a millisecond longer than nominal, and shortened by
                # three whenever its client has run ahead of its server, which ticks at 20 Hz.
                msec += -2 if state[LEAD] >= -5 else 1
                elapsed = state[CLOCK] + nominal_msec
                state[CLOCK] = elapsed % 50
                state[LEAD] += msec - (elapsed - state[CLOCK])
            if state[GOAL_MET] != 0:
                # The level starts again; what was done in this frame has no effect.
                state[GOAL_MET] = 0
                state[APPLES] = (1 << num_apples[m]) - 1
                state[LOTTERY] = (69069 * state[LOTTERY] + 1) & 0xFFFFFFFF
                spawn = ((state[LOTTERY] >> 16) * num_spawns[m]) >> 16
                state[LOTTERY] = (69069 * state[LOTTERY] + 1) & 0xFFFFFFFF
                state[SPAWN_HEADING] = state[LOTTERY] >> 16
                px, py = spawn_position[m, spawn, 0], spawn_position[m, spawn, 1]
                vx, vy, yaw, down = _ZERO, _ZERO, _ZERO, _ZERO
                continue
            for k in range(num_apples[m]):
                if state[APPLES] >> k & 1 and _touches(
                    px, py, apple_position[m, k, 0], apple_position[m, k, 1]
                ):
                    state[APPLES] &= ~(1 << k)
                    gain += apple_reward
            if _touches(px, py, goal_position[m, 0], goal_position[m, 1]):
                state[GOAL_MET] = 1
                gain += goal_reward
            yaw = _wrap(yaw - f(look) * turn)
            down = min(_MAX_PITCH, max(-_MAX_PITCH, down + f(pitch) * turn))
            seconds = f(msec) * _MSEC
            speed = f(math.sqrt(vx * vx + vy * vy))
            if speed < _ONE:
                vx, vy = _ZERO, _ZERO
            else:
                lost = max(speed, _STOP_SPEED) * friction * seconds
                kept = max(_ZERO, speed - lost) / speed
                vx, vy = vx * kept, vy * kept
            if forward != 0 or right != 0:
                units = _heading_units(yaw, state[SPAWN_HEADING])
                angle = f(units) * f(360.0 / 65536.0) * f(math.pi / 180.0)
                cosine, sine = f(math.cos(angle)), f(math.sin(angle))
                wx = f(forward) * cosine + f(right) * sine
                wy = f(forward) * sine - f(right) * cosine
                length = f(math.sqrt(wx * wx + wy * wy))
                wx, wy = wx / length, wy / length
                missing = _SPEED - (vx * wx + vy * wy)
                if missing > _ZERO:
                    gained = min(_ACCELERATION * seconds * _SPEED, missing)
                    vx, vy = vx + gained * wx, vy + gained * wy
            if vx != _ZERO or vy != _ZERO:
                px, py, vx, vy = _slide(px, py, vx, vy, seconds, faces[m], planes)
            vx, vy = np.rint(vx), np.rint(vy)
        pairs[0, i, 0], pairs[0, i, 1] = px, py
        pairs[1, i, 0], pairs[1, i, 1] = vx, vy
        pairs[2, i, 0], pairs[2, i, 1] = yaw, down
        reward[i, 0] = gain
        ends[0, i, 0] = stops_at_goal and state[GOAL_MET] != 0
        ends[1, i, 0] = state[FRAME] >= max_frames
        ends[2, i, 0] = ends[0, i, 0] or ends[1, i, 0]
    read_out(pairs, new_level, maze_index, goal_position)
    return -1


@njit()
def _usable(m, position, velocity, action, faces, table):
    """Whether nothing would be read outside the arrays, nor a number that is none be carried on."""
    if not 0 <= m < faces.shape[0]:
        return False
    if len(action) == 1:
        if not 0 <= action[0] < len(table):
            return False
    elif max(abs(action[0]), abs(action[1])) > 512 or max(abs(action[2]), abs(action[3])) > 1:
        return False
    inside = _ZERO <= position[0] < f(faces.shape[2]) * CELL
    inside &= _ZERO <= position[1] < f(faces.shape[1]) * CELL
    return inside and abs(velocity[0]) < f(1e4) and abs(velocity[1]) < f(1e4)


@njit()
def overlaps_wall(
    position,  # float32 [n, 2]
    maze_index,  # int64 [n]
    faces,  # uint8 [M, R, C]
):
    """Whether each player's box is in a wall, bool ``[n]``; such a wall would not stop it."""
    n = position.shape[0]
    out = np.zeros(n, np.bool_)
    reach = _HALF_WIDTH + _ONE
    for i in range(n):
        px, py = position[i, 0], position[i, 1]
        sides_of = faces[maze_index[i]]
        rows, columns = sides_of.shape
        for row in range(max(0, int((py - reach) / CELL)), min(rows, int((py + reach) / CELL) + 1)):
            for column in range(
                max(0, int((px - reach) / CELL)), min(columns, int((px + reach) / CELL) + 1)
            ):
                sides = sides_of[row, column]
                x, y = px - f(column) * CELL, py - f(row) * CELL  # from the cell's corner
                if not (
                    -_HALF_WIDTH <= x <= CELL + _HALF_WIDTH
                    and -_HALF_WIDTH <= y <= CELL + _HALF_WIDTH
                ):
                    continue
                out[i] |= (
                    (sides & WEST and x <= reach)
                    or (sides & EAST and x >= CELL - reach)
                    or (sides & SOUTH and y <= reach)
                    or (sides & NORTH and y >= CELL - reach)
                )
    return out


@njit()
def _touches(px, py, x, y):
    dx, dy = px - x, py - y
    return _REACH_WEST <= dx <= _REACH_EAST and -_REACH_Y <= dy <= _REACH_Y


@njit()
def _wrap(degrees):
    """An angle modulo a full turn, from 0 to 360."""
    if degrees < _ZERO:
        return degrees + f(360.0)
    if degrees >= f(360.0):
        return degrees - f(360.0)
    return degrees

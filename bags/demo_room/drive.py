"""The robot: where it drives, where its camera is, and what its wheels report.

Frames: `map`, `odom`, `base_link` (x forward, z up, on the floor between the wheels) and
`camera_optical_frame` (x right, y down, z forward). T_a_b maps points of b into a.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .surfaces import Array

DURATION = 21.9  # seconds
IMAGE_RATE, ODOM_RATE = 10, 50  # hertz
START = (1.9, 1.35, 1.0)  # x, y in metres, yaw in degrees
# for how long (s), forward speed (m/s), turn rate (deg/s, left positive)
COMMANDS = (
    (0.5, 0.0, 0.0),
    (4.05, 0.68, 0.0),  # past the sofa, towards the window
    (2.3, 0.50, 38.0),
    (0.9, 0.60, 0.0),
    (2.5, 0.50, 38.0),
    (1.7, 0.68, 0.0),  # along the sideboard
    (1.1, 0.60, -20.0),  # a look at the bookshelf
    (0.5, 0.50, 0.0),
    (2.5, 0.05, 41.0),  # almost on the spot, past the desk
    (3.6, 0.68, 0.0),  # up to the bare wall
    (1.7, 0.05, 38.0),
    (9.9, 0.0, 0.0),
)
MAX_ACCELERATION, MAX_TURN_ACCELERATION = 0.7, np.radians(110.0)  # m/s^2, rad/s^2
STEP = 0.002  # seconds of one integration step

CAMERA_HEIGHT, CAMERA_FORWARD, CAMERA_PITCH = 0.62, 0.12, 5.0  # metres, metres, degrees up

# wheel odometry: a worn tyre, a wheelbase that is a little off, slip and encoder noise
ODOM_SCALE, ODOM_TURN_SCALE, ODOM_TURN_BIAS = 1.018, 0.975, np.radians(0.12)
ODOM_SPEED_NOISE, ODOM_TURN_NOISE = 0.012, np.radians(0.9)  # standard deviations of a reading


@dataclass(frozen=True)
class Odometry:
    """Readings at times [N]: pose (x, y, yaw) [N, 3] in `odom`, speed and turn rate [N]."""

    times: Array
    x_y_yaw: Array
    speed: Array
    turn: Array


class Drive:
    """The true motion, sampled every STEP seconds."""

    def __init__(self) -> None:
        self.times = np.arange(-0.2, DURATION + 0.4, STEP)
        self.speed, self.turn = _velocities(self.times)
        x, y, yaw = START
        self.x_y_yaw = integrate(self.speed, self.turn, (x, y, float(np.radians(yaw))))

    def base_at(self, time: float) -> Array:
        """(x, y, yaw) of base_link in map at a time in seconds."""
        return np.array([np.interp(time, self.times, column) for column in self.x_y_yaw.T])

    def T_map_cam(self, time: float) -> Array:
        """Pose [4, 4] of the camera, with the shaking of the robot's body."""
        x, y, yaw = self.base_at(time)
        speed = float(np.interp(time, self.times, self.speed))
        shake = np.radians(0.04 + 0.3 * speed)
        pitch = shake * (0.6 * np.sin(23.1 * time) + 0.4 * np.sin(41.7 * time + 1.0))
        roll = shake * (0.6 * np.sin(17.3 * time + 2.0) + 0.4 * np.sin(53.9 * time))
        T_base_body = np.eye(4)
        T_base_body[:3, :3] = rotation(0.0, pitch, roll)
        return planar(x, y, yaw) @ T_base_body @ T_base_cam()


def _velocities(times: Array) -> tuple[Array, Array]:
    """Speed and turn rate [N] that follow COMMANDS within the limits of acceleration."""
    ends = np.cumsum([c[0] for c in COMMANDS])
    stage = np.searchsorted(ends, times, side="right")
    wanted_speed = np.array([c[1] for c in COMMANDS])[stage]
    wanted_turn = np.radians([c[2] for c in COMMANDS])[stage]
    speed = _limited(wanted_speed, MAX_ACCELERATION * STEP)
    turn = _limited(wanted_turn, MAX_TURN_ACCELERATION * STEP)
    return _averaged(speed, 0.3), _averaged(turn, 0.3)


def _limited(wanted: Array, largest: float) -> Array:
    result, value = np.empty_like(wanted), 0.0
    for i, goal in enumerate(wanted):
        value += min(max(goal - value, -largest), largest)
        result[i] = value
    return result


def _averaged(values: Array, seconds: float) -> Array:
    """Mean over the last `seconds`: bounds the jerk."""
    n = round(seconds / STEP)
    sums = np.concatenate([np.zeros(n), values]).cumsum()
    return np.concatenate([[0.0], sums[n:] - sums[:-n]])[1 : len(values) + 1] / n


def integrate(speed: Array, turn: Array, start: tuple[float, float, float]) -> Array:
    """(x, y, yaw) [N, 3] of a differential drive, STEP seconds apart."""
    yaw = start[2] + np.concatenate([[0.0], np.cumsum(turn[:-1]) * STEP])
    middle = yaw + turn * STEP / 2
    x = start[0] + np.concatenate([[0.0], np.cumsum((speed * np.cos(middle))[:-1]) * STEP])
    y = start[1] + np.concatenate([[0.0], np.cumsum((speed * np.sin(middle))[:-1]) * STEP])
    return np.stack([x, y, yaw], 1)


def simulate_odometry(drive: Drive) -> Odometry:
    """What the wheels report from time 0 on, drifting away from the truth."""
    rng = np.random.default_rng(31)
    begin = int(np.argmin(np.abs(drive.times)))
    true_speed, true_turn = drive.speed[begin:], drive.turn[begin:]
    every = round(1 / ODOM_RATE / STEP)
    count = -(-len(true_speed) // every)
    moving = (np.abs(true_speed) > 1e-6)[::every]
    noise_v = rng.normal(0, ODOM_SPEED_NOISE, count) * moving
    noise_w = rng.normal(0, ODOM_TURN_NOISE, count) * moving
    hold = np.repeat(np.arange(count), every)[: len(true_speed)]
    speed = true_speed * ODOM_SCALE + noise_v[hold]
    turn = true_turn * ODOM_TURN_SCALE + noise_w[hold] + ODOM_TURN_BIAS * moving[hold]
    x_y_yaw = integrate(speed, turn, (0.0, 0.0, 0.0))[::every]
    times = np.arange(count) / ODOM_RATE
    keep = times <= DURATION + 0.05
    return Odometry(times[keep], x_y_yaw[keep], speed[::every][keep], turn[::every][keep])


def image_times() -> Array:
    """Seconds from the start at which images are taken."""
    return np.arange(round(DURATION * IMAGE_RATE) + 1) / IMAGE_RATE


# ---------------------------------------------------------------- transforms
def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll), radians."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return np.asarray(rz @ ry @ rx)


def planar(x: float, y: float, yaw: float) -> Array:
    """Pose [4, 4] on the floor."""
    T = np.eye(4)
    T[:3, :3] = rotation(yaw, 0.0, 0.0)
    T[:2, 3] = x, y
    return T


def optical(yaw: float, pitch_up: float) -> Array:
    """Rotation [3, 3] of an optical frame that looks along yaw, raised by pitch_up (radians)."""
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return rotation(yaw, -pitch_up, 0.0) @ axes


def T_base_cam() -> Array:
    """The camera's mounting."""
    T = np.eye(4)
    T[:3, :3] = optical(0.0, float(np.radians(CAMERA_PITCH)))
    T[:3, 3] = CAMERA_FORWARD, 0.0, CAMERA_HEIGHT
    return T


def mapping_poses() -> list[Array]:
    """T_map_cam of an earlier mapping run: stops in the free space, a turn of views at each."""
    stops = (
        (1.0, 0.8), (2.0, 0.9), (3.1, 1.25), (4.4, 1.3), (5.6, 1.2), (5.7, 3.2), (5.0, 3.9),
        (4.0, 3.8), (3.0, 3.9), (2.0, 3.9), (1.9, 2.9), (1.0, 2.2), (2.4, 1.9), (3.1, 3.0),
    )  # fmt: skip
    poses = []
    for stop, (x, y) in enumerate(stops):
        for k in range(7):
            yaw = 2 * np.pi * (k + 0.37 * stop) / 7
            T = np.eye(4)
            T[:3, :3] = optical(yaw, float(np.radians((-6.0, 4.0, 12.0)[(k + stop) % 3])))
            T[:3, 3] = x, y, (0.55, 0.75, 1.0)[(2 * k + stop) % 3]
            poses.append(T)
    return poses

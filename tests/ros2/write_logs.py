"""Writes recordings of a simulated skid-steered robot by libraries that are not ours.

    python write_logs.py FOLDER

The robot is simulated by the few lines below: a rigid body on four contacts, each with a deflection
that follows slip within a relaxation length, and a force that saturates, `μ = μ_p tanh(K λ / μ_p)`,
so that K is the slope at zero slip. A resistance of the ground acts on each contact. Accelerations shift the load.
Nothing of it is shared with Tread.
It drives figure-8s at changing speed, in two drives with a pause between them.

    good.mcap   wheels 50 Hz, inertial unit 100 Hz, pose 10 Hz, written by `mcap` with mcap-ros2-support
    good/       the same messages as rosbag2 with SQLite, written by `rosbags`
    slow.mcap   wheels 5 Hz, the rest as in good.mcap
    noisy.mcap  as good.mcap, with white noise on the wheel speeds, as a filter or an analogue sensor has it
    soft.mcap   softer ground, on which the friction curve bends from the beginning, `μ = K λ / (1 + K λ / μ_p)`
    torn.mcap   good.mcap, cut off in the middle
    two.mcap    good.mcap with a second inertial unit

Prints one JSON object: the robot's measures, θ = 1/K, and that of the softer ground.
"""

import dataclasses
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap_ros2.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

ROBOT = {"mass_kg": 50.0, "track_m": 0.57, "wheelbase_m": 0.51, "wheel_radius_m": 0.165, "yaw_inertia_kg_m2": 5.0}
STIFFNESS = 4.0
SOFT_STIFFNESS = 0.7
GRAVITY_M_S2 = 9.80665
WHEEL_LAG_S = 0.08
STEP_S = 0.001
DRIVE_S = 80.0
PAUSE_S = 4.0
BEGIN_NS = 1_750_000_000_000_000_000
COUNTS_PER_TURN = 16384
GYRO_NOISE_RAD_S, GYRO_OFFSET_RAD_S, ACCELERATION_NOISE_M_S2 = 0.003, 0.001, 0.05
WHEEL_NOISE_RAD_S = 0.02
POSE_NOISE_M, POSE_NOISE_RAD = 0.02, 0.01
JOINTS = ["front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"]

store = get_typestore(Stores.ROS2_JAZZY)


def wanted(at_s):
    """Forward speed and turn rate that the driver wants: figure-8s at changing speed."""
    within_s = at_s % (DRIVE_S + PAUSE_S)
    if not 1.0 < within_s < DRIVE_S:
        return 0.0, 0.0
    speed = 0.65 + 0.3 * math.sin(2.0 * math.pi * within_s / 4.0)
    return speed, 0.5 * math.sin(2.0 * math.pi * within_s / 11.0) * speed / 0.65


def saturating(slip, ground):
    """Friction coefficient over slip: `μ = μ_p tanh(K λ / μ_p)`."""
    return ground.peak * math.tanh(ground.stiffness * slip / ground.peak) / slip if slip > 1e-9 else ground.stiffness


def bending(slip, ground):
    """Friction coefficient over slip: `μ = K λ / (1 + K λ / μ_p)`."""
    return ground.stiffness / (1.0 + ground.stiffness * slip / ground.peak)


@dataclasses.dataclass(frozen=True)
class Ground:
    """Contacts of tyres and ground, and what else of the robot the measures do not tell."""

    stiffness: float = STIFFNESS
    peak: float = 0.8
    curve: Callable = saturating
    relaxation_m: float = 0.03
    resistance: float = 0.015
    """Force against the motion over load, at the contacts."""
    practical_slip: float = 0.0
    """0 if slip is relative to the rim speed, 1 if it is to the forward speed of the wheel's centre."""
    height_m: float = 0.2
    """Height of the centre of mass."""


def simulate(random, ground=Ground()):
    """The robot's sensors at 100 Hz: means over the time since the sample before."""
    mass, track, base = ROBOT["mass_kg"], ROBOT["track_m"], ROBOT["wheelbase_m"]
    radius, inertia = ROBOT["wheel_radius_m"], ROBOT["yaw_inertia_kg_m2"]
    load = mass * GRAVITY_M_S2 / 4.0
    contacts = [(base / 2, track / 2, 0), (base / 2, -track / 2, 1), (-base / 2, track / 2, 0), (-base / 2, -track / 2, 1)]
    forward = left = turn = heading = x = y = push_x = push_y = 0.0
    wheels, bent = [0.0, 0.0], np.zeros((4, 2)).tolist()
    every = round(0.01 / STEP_S)
    sums, samples = np.zeros(5), []
    for step in range(round(2 * (DRIVE_S + PAUSE_S) / STEP_S)):
        speed, rate = wanted(step * STEP_S)
        # The driver knows that the robot turns less than its wheels say.
        half = 0.5 * rate * track * (1.0 + (base / track) ** 2)
        for side, rim in ((0, speed - half), (1, speed + half)):
            wheels[side] += (rim / radius - wheels[side]) * STEP_S / WHEEL_LAG_S
        force_x = force_y = moment = 0.0
        for number, (at_x, at_y, side) in enumerate(contacts):
            rim, own = wheels[side] * radius, bent[number]
            sliding = rim - (forward - turn * at_y), -(left + turn * at_x)
            reference = abs(rim) + ground.practical_slip * (abs(forward - turn * at_y) - abs(rim))
            for axis in (0, 1):
                own[axis] += (sliding[axis] - reference * own[axis]) * STEP_S / ground.relaxation_m
                # A standing wheel deflects no further than its contact holds.
                own[axis] = max(-1.0, min(1.0, own[axis]))
            slip = math.hypot(*own)
            shift = ground.height_m * (push_x * math.copysign(1, at_x) / base + push_y * math.copysign(1, at_y) / track) / 2.0
            weight = load - mass * shift
            stiffness = ground.curve(slip, ground)
            along = weight * (stiffness * own[0] - ground.resistance * math.tanh(rim / 0.01))
            across = weight * stiffness * own[1]
            # A contact at rest is damped by its rubber.
            if abs(rim) < 0.1:
                along += weight * sliding[0] * (1.0 - abs(rim) / 0.1)
                across += weight * sliding[1] * (1.0 - abs(rim) / 0.1)
            force_x += along
            force_y += across
            moment += at_x * across - at_y * along
        push_x, push_y = force_x / mass, force_y / mass
        forward += (push_x + turn * left) * STEP_S
        left += (push_y - turn * forward) * STEP_S
        turn += moment / inertia * STEP_S
        heading += turn * STEP_S
        x += (forward * math.cos(heading) - left * math.sin(heading)) * STEP_S
        y += (forward * math.sin(heading) + left * math.cos(heading)) * STEP_S
        sums += (wheels[0], wheels[1], turn, push_x, push_y)
        if (step + 1) % every == 0:
            means = sums / every
            sums = np.zeros(5)
            means[2] += GYRO_OFFSET_RAD_S + random.normal(0.0, GYRO_NOISE_RAD_S)
            means[3:] += random.normal(0.0, ACCELERATION_NOISE_M_S2, 2)
            samples.append((round((step + 1) * STEP_S * 1e9), means, (x, y, heading)))
    return samples


def make(kind, *fields):
    return store.types[kind](*fields)


def header(at_ns, frame):
    stamp_ns = BEGIN_NS + at_ns
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9), frame)


def yawed(heading):
    return make("geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


def vector(x, y, z):
    return make("geometry_msgs/msg/Vector3", x, y, z)


def messages(samples, wheel_hz, random, wheel_noise_rad_s=0.0):
    """(topic, message, time), by time. Wheel speeds are counts of an encoder over the time since the last ones."""
    unmeasured = np.array([-1.0] + [0.0] * 8)
    per_wheels = round(100 / wheel_hz)
    angles, counted = np.zeros(2), np.zeros(2)
    for number, (at_ns, (left, right, turn, push_x, push_y), (x, y, heading)) in enumerate(samples, start=1):
        angles += (left * 0.01, right * 0.01)
        imu = make(
            "sensor_msgs/msg/Imu", header(at_ns, "imu_link"), yawed(0.0), unmeasured, vector(0.0, 0.0, turn),
            np.zeros(9), vector(push_x, push_y, GRAVITY_M_S2), np.zeros(9),
        )
        yield "/imu/data", imu, at_ns
        if number % per_wheels == 0:
            before, counted = counted, np.floor(angles / (2 * math.pi) * COUNTS_PER_TURN) * (2 * math.pi) / COUNTS_PER_TURN
            noise = random.normal(0.0, wheel_noise_rad_s, 2) if wheel_noise_rad_s else 0.0
            speeds = np.tile((counted - before) * wheel_hz + noise, 2)
            joints = make("sensor_msgs/msg/JointState", header(at_ns, ""), JOINTS, np.tile(counted, 2), speeds, np.zeros(0))
            yield "/joint_states", joints, at_ns
        if number % 10 == 0:
            spot = make("geometry_msgs/msg/Point", x + random.normal(0.0, POSE_NOISE_M), y + random.normal(0.0, POSE_NOISE_M), 0.0)
            covariance = np.zeros(36)
            covariance[0] = covariance[7] = POSE_NOISE_M**2
            covariance[35] = POSE_NOISE_RAD**2
            pose = make("geometry_msgs/msg/Pose", spot, yawed(heading + random.normal(0.0, POSE_NOISE_RAD)))
            pose = make("geometry_msgs/msg/PoseWithCovariance", pose, covariance)
            yield "/pose", make("geometry_msgs/msg/PoseWithCovarianceStamped", header(at_ns, "map"), pose), at_ns


def plain(value):
    """A message as mcap-ros2-support takes it: dictionaries and lists."""
    if hasattr(value, "__msgtype__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def write_mcap(path, messages):
    with path.open("wb") as file:
        writer = McapWriter(file)
        schemas = {}
        for topic, message, at_ns in messages:
            kind = message.__msgtype__
            if kind not in schemas:
                definition = store.generate_msgdef(kind, ros_version=2)[0]
                schemas[kind] = writer.register_msgdef(datatype=kind, msgdef_text=definition)
            writer.write_message(topic, schemas[kind], plain(message), log_time=BEGIN_NS + at_ns, publish_time=BEGIN_NS + at_ns)
        writer.finish()


def write_bag(path, messages):
    with BagWriter(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connections = {}
        for topic, message, at_ns in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], BEGIN_NS + at_ns, store.serialize_cdr(message, kind))


def main():
    folder = Path(sys.argv[1])
    samples = simulate(np.random.default_rng(7))
    good = list(messages(samples, 50, np.random.default_rng(8)))
    write_mcap(folder / "good.mcap", good)
    write_bag(folder / "good", good)
    write_mcap(folder / "slow.mcap", messages(samples, 5, np.random.default_rng(9)))
    write_mcap(folder / "noisy.mcap", messages(samples, 50, np.random.default_rng(10), WHEEL_NOISE_RAD_S))
    soft = simulate(np.random.default_rng(11), Ground(SOFT_STIFFNESS, curve=bending))
    write_mcap(folder / "soft.mcap", messages(soft, 50, np.random.default_rng(12)))
    whole = (folder / "good.mcap").read_bytes()
    (folder / "torn.mcap").write_bytes(whole[: len(whole) // 2])
    second = [("/imu/other", message, at_ns) for topic, message, at_ns in good if topic == "/imu/data"]
    write_mcap(folder / "two.mcap", sorted(good + second, key=lambda entry: entry[2]))
    print(json.dumps({"robot": ROBOT, "theta": 1.0 / STIFFNESS, "soft_theta": 1.0 / SOFT_STIFFNESS}))


if __name__ == "__main__":
    main()

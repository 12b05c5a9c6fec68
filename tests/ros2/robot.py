"""A skid-steered robot that speaks as `rmw_zenoh_cpp` does, with physics of its own.

It is a second opinion on everything that the agent takes for ROS 2: keys, hashes, attachments, liveliness
tokens, messages (by `rosbags`), frames and signs. It has its own plant: four wheels with combined
slip on one ground, a servo with lag, and noisy sensors. Faults are switched by lines on its standard
input, such as `silent on`; on its standard output it writes one JSON object a line.
"""

import argparse
import json
import math
import random
import sys
import threading
import time

import numpy as np
import xxhash
import zenoh
from rosbags.typesys import Stores, get_typestore

STEP_S = 0.001
# Commands act after so many steps at the latest, as on a base with a fast loop of its own.
STEPS = 2
SENSOR_S = 0.01
SLIP_SPEED_M_S = 0.05
GRAVITY = 9.80665
COMMAND_TIMEOUT_S = 0.5
# What the base itself takes its wheels' radius for.
BASE_RADIUS = 0.08

store = get_typestore(Stores.ROS2_JAZZY)


def message(kind, *fields):
    return store.types[kind](*fields)


def vector(x, y, z):
    return message("geometry_msgs/msg/Vector3", x, y, z)


def turned(yaw):
    return message("geometry_msgs/msg/Quaternion", 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))


class Plant:
    """A body on four wheels; forces oppose each contact's slip, isotropically."""

    def __init__(self, arguments, rng):
        self.mass, self.track, self.base, self.radius, self.inertia = 5.0, 0.43, 0.28, arguments.radius, 0.45
        self.stiffness, self.lag = arguments.stiffness, arguments.lag
        self.radius_ratio = [1 + 0.01 * rng.uniform(-1, 1) for _ in range(2)]
        # x, y, heading, forward speed, speed to the left, turn rate, wheel speeds left and right
        self.state = [arguments.x, arguments.y, arguments.heading, 0.0, 0.0, 0.0, 0.0, 0.0]
        self.command = [0.0, 0.0]
        self.sides = [0.0, 0.0]

    def friction(self, slip):
        peak, left = 0.2, 0.8
        if slip < peak:
            return self.stiffness
        beyond = (min(slip, 1.0) - peak) / (1.0 - peak)
        return self.stiffness * peak * (1.0 - (1.0 - left) * beyond) / slip

    def rates(self, state):
        _, _, heading, ahead, left, turn, *wheels = state
        load = self.mass * GRAVITY / 4
        force_x = force_y = moment = 0.0
        sides = [0.0, 0.0]
        for side, sign in ((0, 1.0), (1, -1.0)):
            rim = wheels[side] * self.radius * self.radius_ratio[side]
            reference = (rim**4 + SLIP_SPEED_M_S**4) ** 0.25
            across_x = ahead - sign * self.track / 2 * turn - rim
            for end in (1.0, -1.0):
                across_y = left + end * self.base / 2 * turn
                slip = math.hypot(across_x, across_y) / reference
                pull = -load * self.friction(slip) / reference
                fx, fy = pull * across_x, pull * across_y
                force_x += fx
                force_y += fy
                moment += end * self.base / 2 * fy - sign * self.track / 2 * fx
                sides[side] += fx
        self.sides = sides
        lag = max(self.lag, 1e-3)
        sin, cos = math.sin(heading), math.cos(heading)
        return [
            ahead * cos - left * sin, ahead * sin + left * cos, turn,
            force_x / self.mass + left * turn, force_y / self.mass - ahead * turn, moment / self.inertia,
            (self.command[0] - wheels[0]) / lag, (self.command[1] - wheels[1]) / lag,
        ], (force_x / self.mass, force_y / self.mass)

    def step(self):
        """Heun's method; what the sensors average over."""
        first, felt = self.rates(self.state)
        guess = [value + STEP_S * rate for value, rate in zip(self.state, first)]
        second, _ = self.rates(guess)
        self.state = [value + STEP_S / 2 * (a + b) for value, a, b in zip(self.state, first, second)]
        torques = []
        for side in range(2):
            rolling = math.tanh(self.state[6 + side] * self.radius / SLIP_SPEED_M_S)
            resistance = 0.01 * self.mass * GRAVITY / 2 * rolling
            torques.append((self.sides[side] + resistance) * self.radius * self.radius_ratio[side])
        return [self.state[6], self.state[7], self.state[5], *felt, *torques]


def session(settings):
    config = zenoh.Config()
    quiet = {"scouting/multicast/enabled": False, "scouting/gossip/enabled": False}
    for key, value in {**settings, **quiet}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class Node:
    """A node as `rmw_zenoh_cpp` shows it; started again it is another one.

    By `--scheme ros2dds` it is what `zenoh-bridge-ros2dds` shows of a robot on DDS: keys without type,
    no attachments and no tokens.
    """

    def __init__(self, robot):
        self.robot = robot
        arguments = robot.arguments
        self.session = session({"mode": "peer", "connect/endpoints": [arguments.endpoint], "listen/endpoints": []})
        self.head = f"@ros2_lv/{arguments.domain}/{self.session.info.zid()}/0"
        self.space = "%" + arguments.namespace.strip("/").replace("/", "%")
        self.tokens, self.entities = [self.token(f"{self.head}/0/NN/%/{self.space}/base")], 0
        self.publishers = {}
        for topic, kind in {
            "joint_states": "sensor_msgs/msg/JointState",
            "imu/data": "sensor_msgs/msg/Imu",
            "vio/odom": "nav_msgs/msg/Odometry",
            "odom": "nav_msgs/msg/Odometry",
            "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
            "battery_state": "sensor_msgs/msg/BatteryState",
        }.items():
            gid = self.announce("MP", topic, kind)
            publisher = self.session.declare_publisher(self.key(topic, kind), express=True)
            self.publishers[topic] = [publisher, gid, 0]
        self.announce("MS", "cmd_vel", "geometry_msgs/msg/Twist")
        key = self.key("cmd_vel", "geometry_msgs/msg/Twist")
        self.subscriber = self.session.declare_subscriber(key, robot.take_command)

    def is_bridge(self):
        return self.robot.arguments.scheme == "ros2dds"

    def token(self, key):
        return None if self.is_bridge() else self.session.liveliness().declare_token(key)

    def name(self, topic):
        return f"{self.robot.arguments.namespace}/{topic}".strip("/")

    def typed(self, kind):
        package, _, name = kind.split("/")
        return f"{package}::msg::dds_::{name}_", store.hash_rihs01(kind)

    def key(self, topic, kind):
        if self.is_bridge():
            return self.name(topic)
        name, hash_ = self.typed(kind)
        if self.robot.is_on("hash") and topic == "joint_states":
            hash_ = "RIHS01_" + 64 * "0"
        return f"{self.robot.arguments.domain}/{self.name(topic)}/{name}/{hash_}"

    def announce(self, role, topic, kind):
        self.entities += 1
        name, hash_ = self.typed(kind)
        mangled = "%" + self.name(topic).replace("/", "%")
        token = f"{self.head}/{self.entities}/{role}/%/{self.space}/base/{mangled}/{name}/{hash_}/::,10:,:,:,,"
        self.tokens.append(self.token(token))
        return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")

    def publish(self, topic, content):
        entry = self.publishers[topic]
        publisher, gid, _ = entry
        entry[2] += 1
        attachment = entry[2].to_bytes(8, "little") + time.time_ns().to_bytes(8, "little") + b"\x10" + gid
        if self.robot.is_on("bare") or self.is_bridge():
            attachment = None
        payload = bytes(store.serialize_cdr(content, content.__msgtype__))
        if self.robot.is_on("short") and topic == "joint_states":
            payload = payload[:-20]
        if self.robot.is_on("hash") and topic == "joint_states":
            self.session.put(self.key(topic, content.__msgtype__), payload, attachment=attachment)
        else:
            for _ in range(2 if self.robot.is_on("twice") else 1):
                publisher.put(payload, attachment=attachment)

    def begin_again(self):
        """As a node whose session has a fixed identifier: started again, it numbers its messages from one."""
        for entry in self.publishers.values():
            entry[2] = 0

    def close(self):
        self.session.close()


class DuplicateCommander:
    """Another node, which writes on a topic that has its writer."""

    def __init__(self, node, topic, kind):
        self.node, self.topic, self.sequence = node, topic, 0
        self.session = session({"mode": "peer", "connect/endpoints": [node.robot.arguments.endpoint], "listen/endpoints": []})
        self.publisher = self.session.declare_publisher(node.key(topic, kind), express=True)
        self.gid = xxhash.xxh3_128_intdigest(str(self.session.info.zid()).encode()).to_bytes(16, "little")

    def write(self, content):
        self.sequence += 1
        attachment = self.sequence.to_bytes(8, "little") + time.time_ns().to_bytes(8, "little") + b"\x10" + self.gid
        payload = bytes(store.serialize_cdr(content, content.__msgtype__))
        self.publisher.put(payload, attachment=None if self.node.is_bridge() else attachment)


class Robot:
    def __init__(self, arguments):
        self.arguments = arguments
        self.rng = random.Random(arguments.seed)
        self.plant = Plant(arguments, self.rng)
        self.bias = [0.02 * self.rng.uniform(-1, 1) for _ in range(2)]
        self.torque_scale = 1 + 0.02 * self.rng.uniform(-1, 1)
        self.faults, self.commanded_at, self.bare_commands, self.commands = {}, 0.0, 0, 0
        self.late, self.duplicates, self.frozen, self.own_command = [], {}, {}, [0.0, 0.0]
        # What `rmw_zenohd` is beside the nodes.
        self.router = session({"mode": "router", "listen/endpoints": [arguments.endpoint]}) if arguments.router else None
        self.node = Node(self)

    def is_on(self, fault):
        return fault in self.faults

    def take_command(self, sample):
        # As rmw_zenoh_cpp: nothing without an attachment.
        is_bare = sample.attachment is None or len(sample.attachment.to_bytes()) != 33
        if is_bare and self.arguments.scheme == "rmw_zenoh":
            self.bare_commands += 1
            return
        twist = store.deserialize_cdr(sample.payload.to_bytes(), "geometry_msgs/msg/Twist")
        sign = -1.0 if self.is_on("flipped") else 1.0
        half = self.plant.track / 2 * sign * twist.angular.z
        ahead = sign * twist.linear.x
        self.own_command = [(ahead - half) / BASE_RADIUS, (ahead + half) / BASE_RADIUS]
        self.plant.command = self.own_command
        self.commanded_at, self.commands = time.monotonic(), self.commands + 1

    def hijack(self):
        """Somebody past every topic, who halts the base every other quarter of a second."""
        if self.is_on("hijack"):
            self.plant.command = [0.0, 0.0] if int(time.monotonic() * 4) % 2 else self.own_command

    def write_as_another(self, fault, topic, content):
        """Another node writes this."""
        if fault not in self.duplicates:
            self.duplicates[fault] = DuplicateCommander(self.node, topic, content.__msgtype__)
        self.duplicates[fault].write(content)

    def held(self, fault, values):
        """What a sensor that froze says: what it said first when it did."""
        if not self.is_on(fault):
            self.frozen.pop(fault, None)
            return values
        return self.frozen.setdefault(fault, values)

    def noisy(self, value, deviation):
        return value + self.rng.gauss(0.0, deviation)

    def averaged(self, value, deviation):
        """A sensor that measures twice for each message, at 200 Hz as the simulated robot's do."""
        return self.noisy(value, deviation / math.sqrt(2))

    def header(self, frame, behind=0.0):
        stamp = time.time_ns() + int(1e9 * (self.faults.get("stamp", 0.0) - behind))
        return message("std_msgs/msg/Header", message("builtin_interfaces/msg/Time", stamp // 10**9, stamp % 10**9), frame)

    def joints(self, means):
        left, right, _, _, _, *torques = means
        speeds = [self.averaged(left, 0.02), self.averaged(right, 0.02)]
        if self.is_on("nan"):
            speeds[0] = math.nan
        if self.is_on("stuck"):
            speeds = [0.0, 0.0]
        speeds, torques = self.held("frozen_joints", (speeds, torques))
        speeds, torques = list(speeds), list(torques)
        if self.is_on("swapped"):
            speeds.reverse()
            torques.reverse()
        if self.is_on("inverted"):
            speeds[0], torques[0] = -speeds[0], -torques[0]
        noise = 0.01 * self.plant.mass * GRAVITY / 2 * self.plant.radius
        # What is off by a factor is off with its noise.
        factor = self.faults.get("effort", 1.0)
        pulls = [factor * self.averaged(torque * self.torque_scale, noise) / 2 for torque in torques]
        names = ["front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"]
        if self.is_on("renamed"):
            names = ["fl_wheel_joint", "fr_wheel_joint", "rl_wheel_joint", "rr_wheel_joint"]
        sides = [0, 1, 0, 1]
        effort = [] if self.is_on("effortless") else [pulls[side] for side in sides]
        return message(
            "sensor_msgs/msg/JointState", self.header(""), names, np.zeros(4),
            np.array([speeds[side] for side in sides]), np.array(effort),
        )

    def imu(self, means):
        _, _, turn, ahead, left, *_ = means
        felt = vector(self.averaged(ahead + self.bias[0], 0.05), self.averaged(left + self.bias[1], 0.05), GRAVITY)
        small = np.diag([1e-4, 1e-4, 1e-4]).flatten()
        turn = self.held("frozen_imu", self.averaged(turn, 0.003) + self.faults.get("bias", 0.0))
        return message(
            "sensor_msgs/msg/Imu", self.header("camera" if self.is_on("frame") else "imu_link"), turned(self.plant.state[2]), small,
            vector(0.0, 0.0, turn), np.diag([9e-6] * 3).flatten(),
            felt, np.diag([2.5e-3] * 3).flatten(),
        )

    def pose(self, x, y, heading):
        position = message("geometry_msgs/msg/Point", x, y, 0.0)
        return message("geometry_msgs/msg/Pose", position, turned(heading))

    def covariant_pose(self):
        x, y, heading = self.plant.state[:3]
        pose = self.pose(self.noisy(x, 0.01), self.noisy(y, 0.01), self.noisy(heading, 0.005))
        covariance = np.diag([1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 2.5e-5]).flatten()
        if self.is_on("covariance"):
            covariance[0] = -1.0
        return message("geometry_msgs/msg/PoseWithCovariance", pose, covariance)

    def odometry(self, ahead, turn):
        ahead, turn = self.held("frozen_odometry", (ahead, turn))
        # The frame of the twist is the body's, unless its writer got that wrong.
        angle = self.plant.state[2] if self.is_on("world") else 0.0
        linear = vector(ahead * math.cos(angle), ahead * math.sin(angle), 0.0)
        twist = message("geometry_msgs/msg/Twist", linear, vector(0.0, 0.0, turn))
        covariance = np.diag([4e-4] * 6).flatten()
        twist = message("geometry_msgs/msg/TwistWithCovariance", twist, covariance)
        return message("nav_msgs/msg/Odometry", self.header("odom", self.faults.get("delay", 0.0)), "base_link", self.covariant_pose(), twist)

    def battery(self):
        none = np.zeros(0, dtype=np.float32)
        return message(
            "sensor_msgs/msg/BatteryState", self.header(""), 24.5, math.nan, math.nan, math.nan, math.nan, math.nan,
            0.75, 2, 1, 3, True, none, none, "", "",
        )

    def say(self, tick, means):
        said = [("imu/data", self.imu(means)), ("joint_states", self.joints(means))]
        if tick % 5 == 0:
            pose = message("geometry_msgs/msg/PoseWithCovarianceStamped", self.header("map"), self.covariant_pose())
            said.append(("pose", pose))
        if tick % 10 == 0:
            said.append(("vio/odom", self.odometry(self.noisy(self.plant.state[3], 0.02), means[2])))
        if tick % 100 == 0:
            said.append(("battery_state", self.battery()))
            self.report(event="truth", state=self.plant.state[:6], commands=self.commands, bare=self.bare_commands)
        if "late" in self.faults:
            self.late.append((time.monotonic() + self.faults["late"], said))
            said = []
        if self.late and self.late[0][0] <= time.monotonic():
            said = self.late.pop(0)[1] + said
        if not self.is_on("silent"):
            for topic, content in said:
                self.node.publish(topic, content)
        if self.is_on("two_imus"):
            self.write_as_another("two_imus", "imu/data", self.imu(means))
        if "rival" in self.faults and tick % 2 == 0:
            ahead = self.faults["rival"]
            self.write_as_another("rival", "cmd_vel", message("geometry_msgs/msg/Twist", vector(ahead, 0.0, 0.0), vector(0.0, 0.0, 0.0)))

    def report(self, **line):
        print(json.dumps(line), flush=True)

    def run(self):
        began, tick, steps = time.monotonic(), 0, []
        self.report(event="ready")
        while not self.is_on("quit"):
            if "restart" in self.faults:
                pause = self.faults.pop("restart")
                self.node.close()
                time.sleep(pause)
                self.plant.command = [0.0, 0.0]
                self.node, began, tick, steps = Node(self), time.monotonic(), 0, []
                self.report(event="restarted")
            if "again" in self.faults:
                time.sleep(self.faults.pop("again"))
                self.node.begin_again()
                began, tick, steps = time.monotonic(), 0, []
            if time.monotonic() - self.commanded_at > COMMAND_TIMEOUT_S:
                self.plant.command = [0.0, 0.0]
            self.hijack()
            for _ in range(STEPS):
                steps.append(self.plant.step())
            if len(steps) * STEP_S >= SENSOR_S:
                self.say(tick, [sum(values) / len(steps) for values in zip(*steps)])
                tick, steps = tick + 1, []
            due = began + tick * SENSOR_S + len(steps) * STEP_S
            time.sleep(max(0.0, due - time.monotonic()))
        self.node.close()

    def listen(self):
        """`<fault> on`, `<fault> off`, `<fault> <number>`; the end of the input ends the robot."""
        for line in sys.stdin:
            fault, value = line.split()
            if value == "off":
                self.faults.pop(fault, None)
            else:
                self.faults[fault] = True if value == "on" else float(value)
        self.faults["quit"] = True


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--endpoint", required=True)
    parser.add_argument("--router", action="store_true", help="be the robot's router too")
    parser.add_argument("--scheme", choices=["rmw_zenoh", "ros2dds"], default="rmw_zenoh")
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--namespace", default="/rover")
    parser.add_argument("--stiffness", type=float, default=2.5)
    parser.add_argument("--radius", type=float, default=0.08)
    parser.add_argument("--lag", type=float, default=0.05)
    parser.add_argument("--x", type=float, default=0.0)
    parser.add_argument("--y", type=float, default=0.0)
    parser.add_argument("--heading", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=7)
    # Threads of Python take turns; the physics must not make a command wait.
    sys.setswitchinterval(0.0005)
    robot = Robot(parser.parse_args())
    threading.Thread(target=robot.listen, daemon=True).start()
    robot.run()


if __name__ == "__main__":
    main()

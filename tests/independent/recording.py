"""Sensors of a simulated robot, and its recording: an MCAP file of ROS 2 messages."""

import struct

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

import plant
from robots import traction_torque_n_m

JOINTS = ["front_left_wheel_joint", "front_right_wheel_joint", "rear_left_wheel_joint", "rear_right_wheel_joint"]
TOPICS = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/imu/data": "sensor_msgs/msg/Imu",
    "/pose": "geometry_msgs/msg/PoseStamped",
}
BEGIN_NS = 1_780_000_000_000_000_000
RECORD_HZ = 1000
WINDOW = 5  # samples of a record over which a sensor takes its mean


class Cdr:
    """Serialises one message (CDR, little-endian)."""

    def __init__(self):
        self.bytes = bytearray()

    def align(self, size):
        self.bytes += bytes(-len(self.bytes) % size)

    def count(self, value):
        self.align(4)
        self.bytes += struct.pack("<I", value)

    def header(self, stamp_ns, frame):
        self.align(4)
        self.bytes += struct.pack("<iI", *divmod(stamp_ns, 10**9))
        self.string(frame)

    def string(self, text):
        encoded = text.encode() + b"\0"
        self.count(len(encoded))
        self.bytes += encoded

    def array(self, values):
        self.align(8)
        self.bytes += np.asarray(values, "<f8").tobytes()

    def sequence(self, values):
        self.count(len(values))
        if len(values):
            self.array(values)

    def message(self):
        return b"\0\1\0\0" + bytes(self.bytes)


def joint_message(stamp_ns, positions_rad, torques_n_m):
    """A JointState without speeds."""
    cdr = Cdr()
    cdr.header(stamp_ns, "base_link")
    cdr.count(len(JOINTS))
    for name in JOINTS:
        cdr.string(name)
    cdr.sequence(positions_rad)
    cdr.sequence([])
    cdr.sequence(torques_n_m)
    return cdr.message()


def imu_message(stamp_ns, yaw_rate_rad_s, specific_force_m_s2):
    """An Imu without orientation, and with unknown covariances."""
    cdr = Cdr()
    cdr.header(stamp_ns, "imu_link")
    cdr.array([0, 0, 0, 1])
    cdr.array([-1] + [0] * 8)
    cdr.array([0, 0, yaw_rate_rad_s])
    cdr.array([0] * 9)
    cdr.array(specific_force_m_s2)
    cdr.array([0] * 9)
    return cdr.message()


def pose_message(stamp_ns, x_m, y_m, heading_rad):
    """A PoseStamped in the plane."""
    cdr = Cdr()
    cdr.header(stamp_ns, "map")
    cdr.array([x_m, y_m, 0, 0, 0, np.sin(heading_rad / 2), np.cos(heading_rad / 2)])
    return cdr.message()


def at(record, column, times_s):
    """A column of the record at these times."""
    return np.interp(times_s, record[:, plant.TIME], record[:, column])


def mean_before(record, column, times_s):
    """Mean of a column over the window before these times."""
    sums = np.concatenate([[0], np.cumsum(record[:, column])])
    ends = np.clip(np.round(times_s * RECORD_HZ).astype(int), WINDOW, len(record))
    return (sums[ends] - sums[ends - WINDOW]) / WINDOW


def stamp_ns(time_s):
    return BEGIN_NS + int(round(time_s * 1e9))


def joints(record, parameters, random):
    """Messages of the wheels: positions in whole ticks, torques with scale error and noise."""
    times_s = np.arange(0.02, record[-1, plant.TIME], 1 / parameters["joints_hz"]) + 0.003
    tick_rad = 2 * np.pi / parameters["ticks"]
    positions, torques = [], []
    for wheel in range(4):
        ticks = at(record, plant.WHEEL_ANGLES + wheel, times_s) / tick_rad + parameters["phase"][wheel]
        positions.append(np.floor(ticks) * tick_rad)
        noise_n_m = 0.01 * traction_torque_n_m(parameters) * random.standard_normal(len(times_s))
        measured = (1 + parameters["torque_scale"]) * mean_before(record, plant.TORQUES + wheel, times_s)
        torques.append(measured + noise_n_m)
    rows = zip(map(stamp_ns, times_s), np.transpose(positions), np.transpose(torques))
    return [(stamp, joint_message(stamp, position, torque)) for stamp, position, torque in rows]


def inertial(record, parameters, random):
    """Messages of the inertial unit: late, with biases and noise."""
    period_s = 1 / parameters["imu_hz"]
    times_s = np.arange(0.02, record[-1, plant.TIME], period_s)
    count = len(times_s)

    def late(column, delay_s):
        return mean_before(record, column, np.maximum(times_s - delay_s, 0.006))

    walk = np.cumsum(random.standard_normal(count)) * parameters["gyro_walk_rad_s_root_s"] * np.sqrt(period_s)
    yaw_rate = late(plant.YAW_RATE, parameters["gyro_delay_s"]) + parameters["gyro_bias_rad_s"] + walk
    yaw_rate += parameters["gyro_noise_rad_s"] * random.standard_normal(count)
    forces = np.array([
        late(plant.FORCE_X, parameters["accelerometer_delay_s"]) + parameters["accelerometer_bias_m_s2"][0],
        late(plant.FORCE_Y, parameters["accelerometer_delay_s"]) + parameters["accelerometer_bias_m_s2"][1],
        np.full(count, plant.GRAVITY_M_S2 * np.cos(parameters["slope_rad"])),
    ])
    forces += parameters["accelerometer_noise_m_s2"] * random.standard_normal((3, count))
    return [(stamp, imu_message(stamp, *row)) for stamp, *row in zip(map(stamp_ns, times_s), yaw_rate, forces.T)]


def poses(record, parameters, random):
    """Messages of a localisation at 10 Hz with noise of 2 cm and 0.01 rad; none if it has none."""
    if not parameters["has_poses"]:
        return []
    times_s = np.arange(0.05, record[-1, plant.TIME], 0.1)
    noisy = [
        at(record, column, times_s) + noise * random.standard_normal(len(times_s))
        for column, noise in ((plant.POSITION_X, 0.02), (plant.POSITION_Y, 0.02), (plant.HEADING, 0.01))
    ]
    return [(stamp, pose_message(stamp, *row)) for stamp, *row in zip(map(stamp_ns, times_s), *noisy)]


def write(path, record, parameters, random):
    """Write the recording of a drive. Messages arrive 1 to 3 ms after their stamps."""
    typestore = get_typestore(Stores.ROS2_HUMBLE)
    messages = []
    for channel, sensor in enumerate((joints, inertial, poses)):
        for stamp, message in sensor(record, parameters, random):
            messages.append((stamp + int(random.uniform(1e6, 3e6)), stamp, channel, message))
    messages.sort(key=lambda message: message[0])
    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="independent")
        channels = []
        for topic, kind in TOPICS.items():
            definition = typestore.generate_msgdef(kind, ros_version=2)[0]
            schema = writer.register_schema(kind, "ros2msg", definition.encode())
            channels.append(writer.register_channel(topic, "cdr", schema))
        for arrival, stamp, channel, message in messages:
            writer.add_message(channels[channel], log_time=arrival, publish_time=stamp, data=message)
        writer.finish()

"""Reads a recording by three readers that are not ours, and compares what they say.

    python recording.py TICKS FILE

`rosbags` opens it without options, as a ROS 2 program would; `mcap` and `mcap-ros2-support` read it as
Foxglove does. What rosbag2 itself asks of an MCAP file is checked field by field, for it is not here:
its profile, messages in CDR, definitions in ros2msg, quality of service in its notation, and a summary
with statistics and chunk indexes.
"""

import json
import math
import sys
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2.metadata import parse_qos

TYPES = {
    "/tread/run": "std_msgs/msg/String",
    "/tread/command": "std_msgs/msg/String",
    "/tread/safety": "std_msgs/msg/String",
    "/tread/tick": "tread_msgs/msg/LoopTick",
    "/tread/odometry": "nav_msgs/msg/Odometry",
    "/tread/cmd_vel": "geometry_msgs/msg/TwistStamped",
    "/tread/imu": "sensor_msgs/msg/Imu",
    "/tread/joint_states": "sensor_msgs/msg/JointState",
    "/tread/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/tread/plan": "nav_msgs/msg/Path",
    "/tread/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
FIGURES = ("number", "monotonic_ns", "judged_ns", "command_left_rad_s", "command_right_rad_s", "theta", "gate")


def expect(is_so, sentence):
    if not is_so:
        sys.exit(f"recording.py: {sentence}")


def figures(tick):
    """What of a tick is compared; NaN equals itself here."""
    values = [getattr(tick, name) for name in FIGURES] + [len(tick.samples)]
    values += [sample.wheel_left_rad_s for sample in tick.samples]
    return tuple("NaN" if isinstance(value, float) and math.isnan(value) else value for value in values)


def by_rosbags(path):
    """What a ROS 2 program reads: each topic's messages counted, all of them decoded, and the ticks."""
    counts, ticks, texts = Counter(), [], []
    with AnyReader([path]) as reader:
        kinds = {connection.topic: connection.msgtype for connection in reader.connections}
        expect(kinds == TYPES, f"rosbags finds other topics or types: {kinds}")
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            counts[connection.topic] += 1
            if connection.topic == "/tread/tick":
                ticks.append(figures(message))
            elif connection.msgtype == "std_msgs/msg/String":
                texts.append(json.loads(message.data))
        expect(reader.message_count == sum(counts.values()), "rosbags counts other messages than it reads")
    return counts, ticks, texts


def by_mcap(path):
    """What Foxglove's own readers read."""
    counts, ticks, texts = Counter(), [], []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        header, summary = reader.get_header(), reader.get_summary()
        expect(header.profile == "ros2", f"the profile is {header.profile!r}")
        expect(summary is not None and summary.statistics is not None, "there is no summary with statistics")
        expect(len(summary.chunk_indexes) > 0, "there is no index of chunks")
        for schema in summary.schemas.values():
            expect(schema.encoding == "ros2msg", f"{schema.name} is defined in {schema.encoding!r}")
        for channel in summary.channels.values():
            expect(channel.message_encoding == "cdr", f"{channel.topic} is encoded in {channel.message_encoding!r}")
            profiles = parse_qos(channel.metadata["offered_qos_profiles"])
            expect(len(profiles) == 1, f"{channel.topic} offers {profiles}")
        for _, channel, _, message in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            if channel.topic == "/tread/tick":
                ticks.append(figures(message))
            elif hasattr(message, "data"):
                texts.append(json.loads(message.data))
        expect(summary.statistics.message_count == sum(counts.values()), "the statistics count other messages")
    return counts, ticks, texts


ticks_recorded, path = int(sys.argv[1]), Path(sys.argv[2])
counts, ticks, texts = by_rosbags(path)
others = by_mcap(path)
expect(
    (counts, sorted(ticks), texts) == (others[0], sorted(others[1]), others[2]),
    "rosbags and mcap read different messages",
)
expect([tick[0] for tick in sorted(ticks)] == list(range(1, ticks_recorded + 1)), "ticks are missing")
expect(texts[0]["robot"] and texts[0]["format"] >= 2, "the run's head is not the first text")
expect(set(counts) == set(TYPES), f"topics without messages: {set(TYPES) - set(counts)}")
print(json.dumps({"messages": sum(counts.values()), "ticks": len(ticks), "topics": len(counts)}))

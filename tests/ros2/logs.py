"""Runs `logs` on recordings that other libraries wrote, and holds what it says against the truth.

    python logs.py LOGS

LOGS is the program. The recordings come from write_logs.py beside this file.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

program = sys.argv[1]


def expect(is_so, sentence):
    if not is_so:
        sys.exit(f"logs.py: {sentence}")


def run(*arguments):
    """Exit status, standard output and standard error."""
    ended = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, timeout=120, check=False)
    return ended.returncode, ended.stdout, ended.stderr


def read(*arguments):
    status, output, errors = run(*arguments, "--json")
    expect(status == 0, f"{arguments} ended with {status}: {output}{errors}")
    said = json.loads(output)
    expect(all(check["holds"] for check in said.get("checks", [])), f"{arguments}: {said.get('checks')}")
    return said


def refused(words, *arguments):
    status, _, errors = run(*arguments)
    expect(status == 1, f"{arguments} ended with {status}")
    first = errors.split("Stack backtrace")[0]
    for word in words:
        expect(word in first, f"{arguments} does not say `{word}`: {first}")


def holds(theta, verdict):
    return verdict["theta"]["low_95"] <= theta <= verdict["theta"]["high_95"]


with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    writer = Path(__file__).with_name("write_logs.py")
    written = subprocess.run([sys.executable, writer, folder], capture_output=True, text=True, check=True)
    truth = json.loads(written.stdout)
    theta = truth["theta"]
    model = [part for name, value in truth["robot"].items() for part in (f"--{name.replace('_', '-')}", value)]

    listed = read(folder / "good.mcap", "--list")
    rates = {topic["name"]: round(topic["rate_hz"]) for topic in listed["topics"]}
    expect(rates == {"/imu/data": 100, "/joint_states": 50, "/pose": 10}, f"the list has other rates: {rates}")
    expect(listed["missing"] == [], f"the list misses {listed['missing']}")

    good = read(folder / "good.mcap", *model)
    verdicts = [*good["passes"], good["overall"]]
    expect(len(good["passes"]) == 2, f"there are {len(good['passes'])} passes, and two drives were recorded")
    for verdict in verdicts:
        expect(verdict["theta"] is not None, f"there is no estimate: {verdict['abstains']}")
        expect(holds(theta, verdict), f"θ is {theta}, and the interval is {verdict['theta']}")
        half = 0.5 * (verdict["theta"]["high_95"] - verdict["theta"]["low_95"])
        expect(half < 0.6 * theta, f"the interval of {verdict['theta']} says next to nothing")
    expect(len(good["pairs"]) == 1, "two passes are one pair")
    track = good["effective_track"]
    ideal = 1.0 + (truth["robot"]["wheelbase_m"] / truth["robot"]["track_m"]) ** 2
    expect(abs(track["ratio"] / ideal - 1.0) < 0.05, f"W_eff/W is {track}, and about {ideal} at low speed")

    def without_files(said):
        return {key: value for key, value in said.items() if key not in ("files", "torn")}

    bag = read(folder / "good", *model)
    expect(without_files(bag) == without_files(good), "rosbag2 and MCAP hold the same messages, and give other results")
    positions = read(folder / "good.mcap", *model, "--from-positions")
    expect(holds(theta, positions["overall"]), f"by positions the interval is {positions['overall']['theta']}")
    noisy = read(folder / "noisy.mcap", *model)
    for verdict in [*noisy["passes"], noisy["overall"]]:
        expect(
            verdict["theta"] is None or holds(theta, verdict),
            f"with noise on the wheel speeds θ is {theta}, and the interval is {verdict['theta']}",
        )
    expect(any(verdict["theta"] for verdict in noisy["passes"]), "with a little noise no pass gives an estimate")
    soft = read(folder / "soft.mcap", *model)
    for verdict in [*soft["passes"], soft["overall"]]:
        expect(verdict["theta"] is not None, f"on soft ground there is no estimate: {verdict['abstains']}")
        expect(
            holds(truth["soft_theta"], verdict),
            f"on soft ground θ is {truth['soft_theta']}, and the interval is {verdict['theta']}",
        )
    named = read(
        folder / "two.mcap", *model, "--imu", "/imu/data",
        "--joints", "front_left_wheel,rear_left_wheel/front_right_wheel,rear_right_wheel",
    )
    expect(named["overall"] == good["overall"], "what is chosen by name gives another result")

    said = []
    for flags in ([], ["--interpolate"]):
        slow = read(folder / "slow.mcap", *model, *flags)
        for verdict in [*slow["passes"], slow["overall"]]:
            if verdict["theta"] is None:
                expect(verdict["abstains"], "an abstention without a reason")
                expect(flags or verdict["abstains"][0]["code"] == "wheel_rate", f"{verdict['abstains']}")
            else:
                expect(holds(theta, verdict), f"at 5 Hz θ is {theta}, and the interval is {verdict['theta']}")
        said.append(slow["overall"]["theta"])
    torn = read(folder / "torn.mcap", *model)
    expect("torn.mcap" in torn["torn"][0], f"nothing says where the file is torn: {torn['torn']}")
    expect(len(torn["passes"]) == 1, "half of the file is one of two drives")

    (folder / "begin.mcap").write_bytes((folder / "good.mcap").read_bytes()[:60])
    refused(["begin.mcap", "torn before its first message"], folder / "begin.mcap", "--list")
    refused(["2 topics", "--imu", "/imu/other  sensor_msgs/msg/Imu"], folder / "two.mcap", *model)
    refused(["no topic `/wheels`", "/joint_states  sensor_msgs/msg/JointState"], folder / "good.mcap", *model, "--wheels", "/wheels")
    refused(["`/pose` is of the type", "sensor_msgs/msg/Imu is needed"], folder / "good.mcap", *model, "--imu", "/pose")
    refused(["no joint `left`", "`rear_right_wheel`"], folder / "good.mcap", *model, "--joints", "left/front_right_wheel")
    refused(["--mass-kg"], folder / "good.mcap")

    def interval(verdict):
        return [round(verdict["theta"][end], 4) for end in ("low_95", "high_95")]

    print(json.dumps({
        "theta": theta, "interval": interval(good["overall"]), "passes": [interval(one) for one in good["passes"]],
        "effective_track": round(track["ratio"], 4), "at_5_hz": said,
        "on_soft_ground": [interval(verdict) for verdict in [*soft["passes"], soft["overall"]]],
        "with_noise": [verdict["theta"] and interval(verdict) for verdict in [*noisy["passes"], noisy["overall"]]],
    }))

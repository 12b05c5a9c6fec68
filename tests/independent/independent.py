"""Runs `logs` on recordings of an independent simulator, and compares its intervals with the truth.

    python independent.py LOGS [--runs N] [--singles N] [--seed S] [--jobs J] [--json | --markdown]

LOGS is the program. The plant is verified first. It ends with 1 if a check does not hold, and with 2 if `logs` fails
or is missing.
"""

import argparse
import json
import multiprocessing
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import plant
import recording
import robots
import tables
import verification


class LogsFailed(Exception):
    """`logs` printed no result: its command and output."""


def interval_of(program, path, make, effort):
    """θ and its interval over the whole recording; None if `logs` abstains."""
    command = [program, path, "--json", "--effort", effort]
    for name in ("mass_kg", "track_m", "wheelbase_m", "wheel_radius_m"):
        command += [f"--{name.replace('_', '-')}", make[name]]
    command = [str(part) for part in command]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    try:
        overall = json.loads(ended.stdout)["overall"]
        theta = overall and overall["theta"]
        return theta and (theta["theta"], theta["low_95"], theta["high_95"])
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        said = f"it ended with {ended.returncode}, {error!r}\n{ended.stdout}{ended.stderr}"
        raise LogsFailed(f"{shlex.join(command)}\n{said}") from error


def drive(work):
    """Simulate one robot, record it, and run `logs` on the recording with torque and without."""
    program, line, seed = work
    parameters = robots.draw(line, seed)
    random = np.random.default_rng([seed, 5, int(line == robots.POPULATION)])
    commands = robots.course(
        parameters["course"], parameters["make"], random, parameters["duration_s"], parameters["turn_multiplier"]
    )
    record, _ = plant.simulate(
        robots.plant_of(parameters, random), *commands, robots.COMMAND_STEP_S, parameters["duration_s"],
        robots.STEP_S, robots.STEPS_PER_RECORD,
    )  # fmt: skip
    if not np.isfinite(record).all():
        raise ArithmeticError(f"{line}, seed {seed}: the simulation diverged")
    make = robots.MAKES[parameters["make"]]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drive.mcap")
        recording.write(path, record, parameters, random)
        intervals = {effort: interval_of(program, path, make, effort) for effort in tables.EFFORTS}
    kept = {key: parameters[key] for key in ("line", "seed", "make", "course", "shape")}
    return kept | {"theta": 1 / parameters["stiffness"], "intervals": intervals}


def run_all(work, jobs):
    """All drives, in their order, with progress on standard error."""
    begin, drives = time.monotonic(), []
    with multiprocessing.Pool(jobs) as pool:
        for done in pool.imap(drive, work):
            drives.append(done)
            if len(drives) % 10 == 0 or len(drives) == len(work):
                seconds = time.monotonic() - begin
                print(f"{len(drives)} of {len(work)} recordings, {seconds:.0f} s", file=sys.stderr, flush=True)
    return drives


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("logs", type=Path, help="the program `logs`")
    parser.add_argument("--runs", type=int, default=120, help="robots of the population")
    parser.add_argument("--singles", type=int, default=9, help="robots of each single deviation")
    parser.add_argument("--seed", type=int, default=5_000_000, help="first seed")
    parser.add_argument("--jobs", type=int, default=1, help="recordings at once")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print one JSON object")
    form.add_argument("--markdown", action="store_true", help="print Markdown, which is the default")
    options = parser.parse_args()
    if not options.logs.is_file():
        parser.error(f"there is no program `{options.logs}`")
    return options


def main():
    options = arguments()
    program = options.logs.resolve()
    print("verifying the plant", file=sys.stderr, flush=True)
    checks = verification.verify()
    work = [(program, robots.POPULATION, options.seed + run) for run in range(options.runs)]
    work += [(program, line, options.seed + run) for run in range(options.singles) for line in robots.SINGLES]
    try:
        lines = tables.lines_of(run_all(work, options.jobs))
    except LogsFailed as failure:
        print(f"independent.py: `logs` failed: {failure}", file=sys.stderr)
        sys.exit(2)
    checks += tables.checks_of(lines)
    if options.json:
        print(json.dumps({"lines": lines, "checks": checks}, ensure_ascii=False))
    else:
        print(f"{tables.table(lines)}\n\n{tables.table_of_checks(checks)}")
    sys.exit(0 if all(checked["holds"] for checked in checks) else 1)


if __name__ == "__main__":
    main()

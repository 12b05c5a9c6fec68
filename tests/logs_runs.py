"""Runs of the program `logs` on many recordings that a simulator writes: the command line, the runs and their report.

`independent/independent.py` and `ros2/population.py` use it.
"""

import argparse
import json
import multiprocessing
import shlex
import subprocess
import sys
import time
from pathlib import Path

LOGS_MAX_S = 600
PROGRESS_EVERY = 10
"""Number of recordings between two lines of progress."""


class LogsFailed(Exception):
    """`logs` printed no result: its command and output."""


def theta_of(program, path, robot, *options):
    """θ over the whole recording as `logs` prints it, a dictionary with `theta`, `low_95` and `high_95`; None if it abstains.

    `robot` has the values of the robot by the names of the program's options.
    """
    command = [program, path, "--json", *options]
    for name, value in robot.items():
        command += [f"--{name.replace('_', '-')}", value]
    command = [str(part) for part in command]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=LOGS_MAX_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise LogsFailed(f"{shlex.join(command)}\nno result after {LOGS_MAX_S} s") from error
    try:
        return json.loads(ended.stdout)["overall"]["theta"]
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        said = f"it ended with {ended.returncode}, {error!r}\n{ended.stdout}{ended.stderr}"
        raise LogsFailed(f"{shlex.join(command)}\n{said}") from error


def options_of(description, counts, seed):
    """The options of the command line. `counts` are numbers of robots: name, default and help."""
    parser = argparse.ArgumentParser(description=description.split("\n", maxsplit=1)[0])
    parser.add_argument("logs", type=Path, help="the program `logs`")
    for name, default, text in counts:
        parser.add_argument(f"--{name}", type=int, default=default, help=text)
    parser.add_argument("--seed", type=int, default=seed, help="first seed")
    parser.add_argument("--jobs", type=int, default=1, help="recordings at once")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print one JSON object")
    form.add_argument("--markdown", action="store_true", help="print Markdown, which is the default")
    options = parser.parse_args()
    if not options.logs.is_file():
        parser.error(f"there is no program `{options.logs}`")
    options.logs = options.logs.resolve()
    return options


def run_all(drive, work, jobs):
    """What `drive` returns for each piece of work, in their order, with progress on standard error. Ends the program with 2
    if `logs` fails."""
    begin, drives = time.monotonic(), []
    try:
        with multiprocessing.Pool(jobs) as pool:
            for done in pool.imap(drive, work):
                drives.append(done)
                if len(drives) % PROGRESS_EVERY == 0 or len(drives) == len(work):
                    seconds = time.monotonic() - begin
                    print(f"{len(drives)} of {len(work)} recordings, {seconds:.0f} s", file=sys.stderr, flush=True)
    except LogsFailed as failure:
        print(f"`logs` failed: {failure}", file=sys.stderr)
        sys.exit(2)
    return drives


def report(lines, checks, markdown, is_json):
    """Prints lines and checks, as JSON or with `markdown`, and ends the program: with 1 if a check does not hold."""
    if is_json:
        print(json.dumps({"lines": lines, "checks": checks}, ensure_ascii=False))
    else:
        print(markdown)
    sys.exit(0 if all(check["holds"] for check in checks) else 1)

"""Checks the API with programs that know nothing but its OpenAPI description.

    python clients.py OPENAPI [--server URL --token FILE] [--seconds S] [--json]

OPENAPI is the committed description, `server/openapi.json`. A validator reads it, a generator writes a
client in Python from it, and every module of that client is imported. With a server, the generated client
lists its sites, and Schemathesis sends requests that the description allows or forbids: no response may have
a status of 500 to 599, or a status, content type or body that the description does not have. The server must
be one for tests, since the requests change it.
"""

import argparse
import importlib
import json
import pkgutil
import subprocess
import sys
import tempfile
from pathlib import Path

from openapi_spec_validator import validate
from openapi_spec_validator.validation.exceptions import OpenAPIValidationError

# Operations that do not end by themselves, or that end the session of the test.
EXCLUDED = ["stream_events", "drive_robot", "end_session", "revoke_token"]
# Not checked is whether each request is accepted that the description allows, since no schema can say that a
# history has too many times, nor whether others are refused, since a stop is accepted whatever its body is.
CHECKS = ["not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance"]


def parsed():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("openapi", type=Path)
    arguments.add_argument("--server", help="URL of a server for tests")
    arguments.add_argument("--token", type=Path, help="file with the token of an admin")
    arguments.add_argument("--seconds", type=int, default=60, help="time for requests to the server")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--json", action="store_true", help="print one object")
    found = arguments.parse_args()
    if found.server is not None and (not found.server or found.token is None):
        arguments.error("--server needs a URL, and the file --token")
    return found


def check(name, goal, value, holds):
    return {"name": name, "goal": goal, "value": value, "holds": holds}


def validated(openapi):
    try:
        validate(json.loads(openapi.read_text()))
    except OpenAPIValidationError as error:
        print(f"{openapi}: {error}", file=sys.stderr)
        return False
    return True


def generated(openapi, folder):
    """Returns the name of the client's package, or None if the generator failed, and the number of warnings."""
    binaries = Path(sys.executable).parent
    command = [binaries / "openapi-python-client", "generate", "--path", openapi, "--output-path", folder, "--overwrite"]
    path = {"PATH": f"{binaries}:/usr/bin:/bin"}
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False, env=path)
    output = ended.stdout + ended.stderr
    warnings = output.count("Unable to") + output.count("WARNING")
    packages = [found.parent.name for found in folder.glob("*/client.py")]
    is_generated = ended.returncode == 0 and len(packages) == 1
    if not is_generated or warnings > 0:
        print(output, file=sys.stderr)
    return (packages[0] if is_generated else None), warnings


def imported(package):
    """Returns how many modules of the package can be imported, and how many cannot."""
    counts = {True: 0, False: 0}
    for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
        try:
            importlib.import_module(module.name)
            counts[True] += 1
        except (ImportError, SyntaxError, NameError, TypeError) as error:
            print(f"{module.name}: {error}", file=sys.stderr)
            counts[False] += 1
    return counts[True], counts[False]


def listed_sites(package, server, token):
    client = importlib.import_module(f"{package}.client").AuthenticatedClient(base_url=server, token=token)
    page = importlib.import_module(f"{package}.api.sites.list_sites").sync(client=client)
    return len(page.items)


def fuzzed(arguments, token, folder):
    """Returns the numbers of operations that were tested, of requests and of failures."""
    report = folder / "report.json"
    command = [Path(sys.executable).parent / "schemathesis", "run", arguments.openapi.resolve(), "--url", arguments.server]
    command += ["--header", f"authorization: Bearer {token}", "--checks", ",".join(CHECKS)]
    command += ["--phases", "examples,coverage,fuzzing", "--max-time", str(arguments.seconds), "--seed", str(arguments.seed)]
    command += ["--continue-on-failure", "--report", "json", "--report-json-path", report]
    for operation in EXCLUDED:
        command += ["--exclude-operation-id", operation]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=arguments.seconds + 300, check=False, cwd=folder)
    if not report.exists():
        sys.exit(f"clients.py: Schemathesis ended with {ended.returncode}: {ended.stdout}{ended.stderr}")
    found = json.loads(report.read_text())
    # A run that ended early has no operations, and is a failure too.
    failures = len(found["failures"]) + len(found["errors"]) + (0 if found["complete"] else 1)
    if failures > 0:
        print(ended.stdout, ended.stderr, file=sys.stderr)
    return (found["operations"] or {"tested": 0})["tested"], found["test_cases"]["generated"], failures


def main():
    arguments = parsed()
    is_valid = validated(arguments.openapi)
    checks = [check("the description is valid OpenAPI", True, is_valid, is_valid)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        package, warnings = generated(arguments.openapi, folder / "client")
        checks.append(check("a client was generated", True, package is not None, package is not None))
        checks.append(check("warnings of the generator of clients", "= 0", warnings, warnings == 0))
        if package is not None:
            sys.path.insert(0, str(folder / "client"))
            modules, broken = imported(package)
            checks.append(check("modules of the client that can be imported", "> 200", modules, modules > 200))
            checks.append(check("modules of the client that cannot", "= 0", broken, broken == 0))
        if arguments.server is not None:
            token = arguments.token.read_text().strip()
            if package is not None:
                sites = listed_sites(package, arguments.server, token)
                checks.append(check("sites that the client lists", "≥ 1", sites, sites >= 1))
            operations, requests, failures = fuzzed(arguments, token, folder)
            checks.append(check("operations that were requested", "≥ 80", operations, operations >= 80))
            checks.append(check("requests", "≥ 1000", requests, requests >= 1000))
            checks.append(check("failures", "= 0", failures, failures == 0))
    if arguments.json:
        print(json.dumps({"checks": checks}))
    else:
        for one in checks:
            print(f"{one['name']}: {one['value']} (goal {one['goal']})" + ("" if one["holds"] else "  DOES NOT HOLD"))
    sys.exit(0 if all(one["holds"] for one in checks) else 1)


main()

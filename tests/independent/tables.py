"""Lines of the result, checks of their coverage, and tables."""

import numpy as np

import robots
from verification import check

HALF_WIDTH_MAX = 0.6  # over the value; wider intervals count as abstaining
COVERAGE_MIN = 0.85
EFFORTS = ("torque", "none")


def count(drives, effort):
    """Coverage and the like of drives with this effort, as fractions."""
    covered, errors, half_widths = 0, [], []
    for drive in drives:
        interval = drive["intervals"][effort]
        if interval is None:
            continue
        value, low, high = interval
        if (high - low) / 2 > HALF_WIDTH_MAX * value:
            continue
        covered += low <= drive["theta"] <= high
        errors.append(value / drive["theta"] - 1)
        half_widths.append((high - low) / 2 / value)
    estimates = len(errors)
    return {
        "recordings": len(drives),
        "estimates": estimates,
        "covered": covered,
        "coverage": covered / estimates if estimates else None,
        "median_half_width": float(np.median(half_widths)) if estimates else None,
        "median_error": float(np.median(errors)) if estimates else None,
        "abstained": 1 - estimates / len(drives) if drives else None,
    }


def lines_of(drives):
    """The population, its strata and the single deviations."""
    population = [drive for drive in drives if drive["line"] == robots.POPULATION]
    groups = [("population", population)]
    if population:
        for shape, name in robots.CURVES.items():
            groups.append((f"population: {name}", [drive for drive in population if drive["shape"] == shape]))
        for name, third in zip(("low", "middle", "high"), thirds(population)):
            groups.append((f"population: {name} K", third))
        for key, names in (("course", robots.COURSES), ("make", robots.MAKES)):
            for name in names:
                groups.append((f"population: {name}", [drive for drive in population if drive[key] == name]))
    for name in robots.SINGLES:
        groups.append((name, [drive for drive in drives if drive["line"] == name]))
    return [
        {"line": name} | {effort: count(group, effort) for effort in EFFORTS} for name, group in groups if group
    ]


def thirds(population):
    """The population by K, in three parts of one size, nearly."""
    ordered = sorted(population, key=lambda drive: -drive["theta"])
    return [[ordered[i] for i in part] for part in np.array_split(np.arange(len(ordered)), 3)]


def checks_of(lines):
    """Coverage of the population for each effort, and of each single deviation over both efforts."""
    checks = []
    for line in lines:
        if line["line"] == robots.POPULATION:
            for effort, words in zip(EFFORTS, ("with torque", "without torque")):
                checks.append(check(f"population, {words}: coverage", "≥", COVERAGE_MIN, line[effort]["coverage"]))
        elif line["line"] in robots.SINGLES:
            estimates = sum(line[effort]["estimates"] for effort in EFFORTS)
            # Where every recording abstains, no interval is wrong.
            coverage = sum(line[effort]["covered"] for effort in EFFORTS) / estimates if estimates else 1.0
            checks.append(check(f"{line['line']}: coverage", "≥", COVERAGE_MIN, coverage))
    return checks


def shown(value, form):
    """A fraction in per cent; a dash if nothing could be counted."""
    return "-" if value is None else format(100 * value, form)


def table(lines):
    """The lines as a Markdown table, with torque and without."""
    titles = ["estimates", "coverage", "half-width", "error", "abstained"]
    rows = [["line", *(f"{title}, torque" for title in titles), *(f"{title}, no torque" for title in titles)]]
    rows.append(["---"] * len(rows[0]))
    for line in lines:
        row = [line["line"]]
        for effort in EFFORTS:
            counted = line[effort]
            row.append(f"{counted['estimates']} of {counted['recordings']}")
            row.append(shown(counted["coverage"], ".0f"))
            row.append(f"±{shown(counted['median_half_width'], '.0f')}" if counted["estimates"] else "-")
            row.append(shown(counted["median_error"], "+.0f"))
            row.append(shown(counted["abstained"], ".0f"))
        rows.append(row)
    return markdown(rows)


def table_of_checks(checks):
    """The checks as a Markdown table."""
    rows = [["check", "goal", "value", "holds"], ["---"] * 4]
    for checked in checks:
        value = "-" if checked["value"] is None else f"{checked['value']:.3g}"
        if "%" in checked["goal"] and checked["value"] is not None:
            value = f"{checked['value']:.0%}".replace("%", " %")
        rows.append([checked["name"], checked["goal"], value, "yes" if checked["holds"] else "**no**"])
    return markdown(rows)


def markdown(rows):
    return "\n".join("|---" * len(row) + "|" if row[0] == "---" else f"| {' | '.join(row)} |" for row in rows)

"""`python .ci/limits.py`: what may not grow; part of `make lint`.

Counts code lines, NamedTuples, public names, lines of the longest file and the processor time that
the budget of tests allows, and compares them with `limits.tsv`. A count above its limit fails, and
so does a limit above what an earlier commit has set, but for what an issue grants by name. With
`--lower`, limits above the counts are set to these.
"""

from __future__ import annotations

import argparse
import ast
import csv
import io
import subprocess
import sys

from code_lines import PACKAGES, TOP, code_lines

TABLE = ".ci/limits.tsv"
#: Code lines that issues may add, by their numbers.
GRANTS = {("29", "29b"): 1200, ("35", "35b", "35c"): 1500}
CURE = {
    "code lines": "delete what the change replaces",
    "NamedTuples": "a new carrier needs two users; return a value or use one that is there",
    "public names": "make it an option or a result of a name that is there",
    "lines of the longest file": "split it by concept",
    "seconds of tests": "share a canonical study (tests/canonical.py) instead of a new program",
}


def counts() -> dict[str, int]:
    """What is limited, by name."""
    sources = {
        path: path.read_text(encoding="utf-8")
        for package in PACKAGES
        for path in sorted((TOP / package).rglob("*.py"))
    }
    classes = [
        node
        for text in sources.values()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ClassDef)
    ]
    stub = ast.parse((TOP / "studies" / "__init__.pyi").read_text(encoding="utf-8"))
    names = [x for node in stub.body if isinstance(node, ast.ImportFrom) for x in node.names]
    with (TOP / "tests" / "budget.tsv").open(encoding="utf-8", newline="") as file:
        seconds = sum(int(row["seconds"]) for row in csv.DictReader(file, delimiter="\t"))
    return {
        "code lines": sum(map(code_lines, sources.values())),
        "NamedTuples": sum("NamedTuple" in map(ast.unparse, node.bases) for node in classes),
        "public names": len(names),
        "lines of the longest file": max(text.count("\n") for text in sources.values()),
        "seconds of tests": seconds,
    }


def read(text: str) -> dict[str, int]:
    """Limits of a table."""
    return {
        row["what"]: int(row["limit"]) for row in csv.DictReader(io.StringIO(text), delimiter="\t")
    }


def write(limits: dict[str, int]) -> None:
    rows = [("what", "limit"), *limits.items()]
    text = "".join(f"{what}\t{limit}\n" for what, limit in rows)
    (TOP / TABLE).write_text(text, encoding="utf-8")


def lowest() -> dict[str, int]:
    """The lowest limits that any commit has set; none without a history."""
    log = _git("log", "--format=%H", "--", TABLE).split()
    found: dict[str, int] = {}
    for commit in log:
        for what, limit in read(_git("show", f"{commit}:{TABLE}")).items():
            found[what] = min(limit, found.get(what, limit))
    return found


def _git(*arguments: str) -> str:
    ended = subprocess.run(["git", *arguments], cwd=TOP, capture_output=True, text=True, timeout=60)
    return ended.stdout


def faults(found: dict[str, int], limits: dict[str, int], before: dict[str, int]) -> list[str]:
    """Sentences on what has grown."""
    said = [
        f"{what}: {found[what]}, limit {limit}; {CURE[what]}"
        for what, limit in limits.items()
        if found[what] > limit
    ]
    for what, limit in limits.items():
        granted = sum(GRANTS.values()) if what == "code lines" else 0
        if limit > before.get(what, limit) + granted:
            said.append(f"{TABLE}: the limit of {what} was {before[what]}; limits only fall")
    return said


def main() -> None:
    parser = argparse.ArgumentParser(description="What may not grow.")
    parser.add_argument("--lower", action="store_true", help="lower limits to the counts")
    is_lowering = parser.parse_args().lower
    found, limits = counts(), read((TOP / TABLE).read_text(encoding="utf-8"))
    if is_lowering:
        limits = {what: min(limit, found[what]) for what, limit in limits.items()}
        write(limits)
    said = faults(found, limits, lowest())
    for what, limit in limits.items():
        print(f"{found[what]:7d}  {what} (limit {limit})")
    for fault in said:
        print(f"limits: {fault}", file=sys.stderr)
    raise SystemExit(bool(said))


if __name__ == "__main__":
    main()

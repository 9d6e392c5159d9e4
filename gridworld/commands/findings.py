"""What `check` and `examine` found, as files for other programs: JSON and JUnit XML, with one schema.

docs/reference/findings.md describes both.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from gridworld.base.atomic_write import write_bytes, write_json
from gridworld.base.console import plain
from gridworld.checking.run import CheckResult
from gridworld.examining.examine import ExamineResult
from gridworld.examining.seen import ERROR
from gridworld.run.folder import check_file

_FORMAT = 1  # of the schema
_FAILED = "failed"
_STATUS = {True: "passed", False: _FAILED, None: "skipped"}


def add_file_options(parser: argparse.ArgumentParser) -> None:
    """Give a command the options `--json` and `--junit`."""
    for option, what in (("--json", "JSON"), ("--junit", "JUnit XML, for CI")):
        parser.add_argument(option, type=Path, metavar="FILE", help=f"a file for what is found, {what}")


def check_files(options: argparse.Namespace) -> None:
    """Raise `InputError` where one of the files cannot be written."""
    for option, path in (("--json", options.json), ("--junit", options.junit)):
        if path is not None:
            check_file(path, option)


def write_files(result: CheckResult | ExamineResult, options: argparse.Namespace) -> None:
    """Write the files that were asked for."""
    content = document(result)
    if options.json is not None:
        write_json(options.json, content)
    if options.junit is not None:
        write_bytes(options.junit, _junit(content))


def document(result: CheckResult | ExamineResult) -> dict[str, Any]:
    """The content of the JSON file; a finding of `check` is a probe, one of `examine` a topic."""
    facts: tuple[tuple[str, str], ...] = ()
    if isinstance(result, CheckResult):
        command = "check"
        findings = [
            {
                "name": each.name,
                "status": _STATUS[each.passed],
                "severity": ERROR if each.passed is False else None,
                "found": each.found,
                "advice": each.advice,
                "may_follow_from": list(each.may_follow_from),
                "seeds": each.seeds,
                "seconds": round(each.seconds, 3),
            }
            for each in result.findings
        ]
    else:
        command, facts = "examine", result.facts
        findings = [
            {
                "name": each.topic,
                "status": _FAILED,
                "severity": each.severity,
                "found": each.evidence,
                "advice": [each.advice],
                "may_follow_from": [],
                "seeds": None,
                "seconds": None,
            }
            for each in result.findings
        ]
    return {
        "format": _FORMAT,
        "command": command,
        "name": result.name,
        "passed": result.passed,
        "seconds": round(result.seconds, 3),
        "facts": dict(facts),
        "findings": findings,
    }


def _junit(content: dict[str, Any]) -> bytes:
    """A suite with a test for each finding; one test that passed where there are none."""
    nothing = {"name": content["command"], "status": "passed", "seconds": content["seconds"]}
    findings = content["findings"] or [nothing]
    statuses = [each["status"] for each in findings]
    suite = ElementTree.Element(
        "testsuite",
        name=plain(f"gridworld {content['command']} {content['name']}"),
        tests=str(len(findings)),
        failures=str(statuses.count(_FAILED)),
        errors="0",
        skipped=str(statuses.count("skipped")),
        time=str(content["seconds"]),
    )
    for each in findings:
        case = ElementTree.SubElement(
            suite,
            "testcase",
            classname=plain(content["name"]),
            name=plain(each["name"]),
            time=str(each["seconds"] or 0.0),
        )
        if each["status"] == _FAILED:
            failure = ElementTree.SubElement(
                case, "failure", type=each["severity"], message=plain(each["found"])
            )
            failure.text = "\n".join(map(plain, each["advice"]))
        elif each["status"] == "skipped":
            ElementTree.SubElement(case, "skipped", message=plain(each["found"]))
    suites = ElementTree.Element("testsuites")
    suites.append(suite)
    ElementTree.indent(suites)
    found: bytes = ElementTree.tostring(suites, encoding="utf-8", xml_declaration=True)
    return found + b"\n"

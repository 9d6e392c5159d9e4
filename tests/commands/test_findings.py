"""What `check` and `examine` write for other programs: JSON and JUnit XML, of one schema."""

import json
from argparse import Namespace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from helpers.support import ROOT

from gridworld.checking.run import CheckResult, Finding
from gridworld.commands import check, examine
from gridworld.commands import findings as files
from gridworld.examining.examine import ExamineResult

KEYS = {"format", "command", "name", "passed", "seconds", "facts", "findings"}
OF_FINDING = {"name", "status", "severity", "found", "advice", "may_follow_from", "seeds", "seconds"}
AGENT = "def train(env, total_timesteps, seed, gamma):\n    return [0] * env.observation_space.n\n"
WORLD = """
import gymnasium as gym

class Endless(gym.Env):
    observation_space, action_space = gym.spaces.Discrete(2), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return int(action), 0.0, False, False, {}
"""


def written(command: Any, words: list[str], folder: Path) -> tuple[int, dict[str, Any], ElementTree.Element]:
    """The exit code, and both files."""
    paths = folder / "found.json", folder / "found.xml"
    code = 0
    try:
        command.main([*words, "--json", str(paths[0]), "--junit", str(paths[1])])
    except SystemExit as ended:
        code = int(str(ended.code))
    found = json.loads(paths[0].read_text())
    assert found.keys() == KEYS
    assert all(each.keys() == OF_FINDING for each in found["findings"])
    (suite,) = ElementTree.parse(paths[1]).getroot()
    cases = suite.findall("testcase")
    assert int(suite.attrib["tests"]) == len(cases)
    for number, kind in ((suite.attrib["failures"], "failure"), (suite.attrib["skipped"], "skipped")):
        assert int(number) == len(suite.findall(f"testcase/{kind}"))
    return code, found, suite


def test_check_writes_what_it_prints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "agent_of_file.py").write_text(AGENT)
    monkeypatch.syspath_prepend(tmp_path)
    probes = ["--probe", "choice", "--probe", "context", "--probe", "entropy", "--processes", "1"]
    code, found, suite = written(check, ["agent_of_file:train", *probes], tmp_path)
    assert (code, found["command"], found["name"]) == (1, "check", "agent_of_file:train")
    assert (found["passed"], found["facts"]) == (False, {})
    choice, context, entropy = found["findings"]
    assert [each["status"] for each in (choice, context, entropy)] == ["failed", "failed", "skipped"]
    assert (choice["severity"], choice["seeds"], entropy["severity"]) == ("error", 2, None)
    assert choice["found"] == "its best actions are [0], with regret 1"
    assert choice["advice"][0].startswith("worse actions are preferred")
    assert context["may_follow_from"] == ["choice"]
    assert context["advice"][1] == "may follow from choice; mend that first"
    first, second, third = suite.findall("testcase")
    assert [each.attrib["name"] for each in (first, second, third)] == ["choice", "context", "entropy"]
    failure = second.find("failure")
    assert failure is not None
    assert (failure.attrib["message"], failure.attrib["type"]) == (context["found"], "error")
    assert failure.text == "\n".join(context["advice"])
    assert third.find("skipped") is not None


def test_examine_writes_the_same_schema(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "world_of_file.py").write_text(WORLD)
    monkeypatch.syspath_prepend(tmp_path)
    code, found, suite = written(examine, ["world_of_file:Endless", "--steps", "500"], tmp_path)
    assert (code, found["command"], found["passed"]) == (1, "examine", False)
    assert {"steps", "observations", "rewards"} <= found["facts"].keys()
    assert {each["status"] for each in found["findings"]} == {"failed"}
    endless = next(each for each in found["findings"] if each["name"] == "termination")
    assert (endless["severity"], endless["may_follow_from"]) == ("error", [])
    assert suite.attrib["name"] == "gridworld examine world_of_file:Endless"
    options = Namespace(json=None, junit=tmp_path / "sound.xml")
    files.write_files(ExamineResult("Sound", (("steps", "deterministic"),), (), 1.0), options)
    (suite,) = ElementTree.parse(options.junit).getroot()
    assert (suite.attrib["tests"], suite.attrib["failures"]) == ("1", "0")
    assert [each.attrib["name"] for each in suite] == ["examine"]


def test_the_page_has_the_schema() -> None:
    page = (ROOT / "docs/reference/findings.md").read_text()
    example = json.loads(page.split("```json")[1].split("```")[0])
    assert (example.keys(), example["findings"][0].keys()) == (KEYS, OF_FINDING)
    assert all(f"`{key}`" in page for key in KEYS | OF_FINDING)


def test_what_a_finding_says_may_be_anything(tmp_path: Path) -> None:
    evil = "training failed: \x00\x1b[2J\ud800 <&\"' ]]>\nnew"
    result = CheckResult("a:b", (Finding("choice", False, evil, "meaning"),), 1.0)
    options = Namespace(json=tmp_path / "a.json", junit=tmp_path / "a.xml")
    files.write_files(result, options)
    assert json.loads(options.json.read_text())["findings"][0]["found"] == evil
    failure = ElementTree.parse(options.junit).getroot().find("testsuite/testcase/failure")
    assert failure is not None
    assert failure.attrib["message"] == r"""training failed: \x00\x1b[2J\ud800 <&"' ]]>\nnew"""

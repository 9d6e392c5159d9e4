"""OmegaConf parses the text of an interpolation once, and reads it as before."""

import inspect
from concurrent.futures import ThreadPoolExecutor

import omegaconf
import omegaconf._utils
import omegaconf.base
import pytest
from omegaconf import OmegaConf, grammar_parser
from omegaconf.errors import GrammarParseError

from gridworld import compose
from gridworld.config.composition.interpolations import parse_each_text_once

WHAT_TO_DO = (
    f"OmegaConf {omegaconf.__version__} changed an internal that "
    "gridworld/config/composition/interpolations.py replaces. Adapt it, or leave out parse_each_text_once, "
    "which saves 25 ms a job."
)


@pytest.fixture
def texts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The texts that are parsed from now on."""
    parsed: list[str] = []

    def parse(value: str) -> object:
        parsed.append(value)
        return own(value)

    own = grammar_parser.parse
    parse_each_text_once()
    monkeypatch.setattr(grammar_parser, "parse", parse)
    return parsed


def test_omegaconf_has_the_internals_that_are_replaced() -> None:
    for module in (omegaconf.base, omegaconf._utils):
        assert callable(getattr(module, "parse", None)), f"No parse in {module.__name__}. {WHAT_TO_DO}"
    words = list(inspect.signature(grammar_parser.parse).parameters)
    assert words == ["value", "parser_rule", "lexer_mode"], WHAT_TO_DO


def test_a_text_is_parsed_once(texts: list[str]) -> None:
    values = {"number": 4, "name": "goal-${number}-only-here"}
    assert [OmegaConf.create({**values, "number": each}).name for each in (1, 2)] == [
        "goal-1-only-here",
        "goal-2-only-here",
    ]
    assert texts == ["goal-${number}-only-here"]


def test_a_long_text_takes_no_memory(texts: list[str]) -> None:
    values = {"number": 4, "name": "goal-${number}-" + 1000 * "o"}
    for _ in range(2):
        assert OmegaConf.create(values).name == "goal-4-" + 1000 * "o"
    assert len(texts) == 2


def test_composing_again_parses_nothing(texts: list[str]) -> None:
    compose("agent=ppo", "env.slip=0.1")
    texts.clear()
    again = compose("agent=ppo", "env.slip=0.2", "seed=3")
    assert texts == []
    assert again.total_timesteps == 24_000_000


def test_a_mistake_is_told_every_time(texts: list[str]) -> None:
    for _ in range(2):
        with pytest.raises(GrammarParseError):
            _ = OmegaConf.create({"name": "${number"}).name


def test_threads_may_read_the_same_text() -> None:
    def read(number: int) -> str:
        return str(OmegaConf.create({"number": number, "name": "from-${number}-in-threads"}).name)

    parse_each_text_once()
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(read, range(200))) == [f"from-{number}-in-threads" for number in range(200)]

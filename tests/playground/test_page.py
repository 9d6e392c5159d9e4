"""The page as people use it: links, files, command lines, drawing, keys, phones; and what strangers send."""

import dataclasses
import json
import shlex
import shutil
import subprocess
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.browser import FITS
from helpers.support import configure
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

import gridworld
from gridworld.base.errors import InputError
from gridworld.base.user_input import called_from
from gridworld.commands import playground as command
from gridworld.config.compose import named_world
from gridworld.report.playground.page import link, run_page, world_page
from gridworld.training.saved_run import SavedRun
from gridworld.world.grid import GridMdp, compile_mdp
from gridworld.world.layout import load, parse

Page = Callable[..., Any]
OWN = "S.#\nC..\nTTG"
TABLES = """
const { world, settings, map } = playground.app, arrays = [world.next, world.prob, world.reward, world.start];
return [arrays.map(each => Array.from(each)), settings.gamma, world.limit, map.tiles];
"""


def message(browser: Any) -> str:
    text: str = browser.find_element("id", "message").text
    return text


def tiles(browser: Any) -> str:
    found: str = browser.execute_script("return playground.app.map.tiles")
    return found


@pytest.mark.parametrize(
    ("layout", "settings", "gamma", "limit"),
    [
        ("maze", {}, 0.99, 300),
        ("aima_4x3", {"slip": 0.2, "step_reward": -0.04}, 0.9, 100),
        (OWN, {"slip": 1 / 3, "step_reward": -1.0, "goal_reward": 0.0, "trap_reward": -7.5}, 1.0, 37),
    ],
    ids=["shipped", "changed", "own"],
)
class TestAWorld:
    """That leaves the page is the same when it comes back."""

    @pytest.fixture
    def mdp(self, layout: str, settings: dict[str, float]) -> GridMdp:
        return compile_mdp(load(layout) if "\n" not in layout else parse(layout, "own"), **settings)

    def test_in_a_link(self, mdp: GridMdp, gamma: float, limit: int, page: Page) -> None:
        browser = page(link(mdp, gamma, limit))
        for _ in range(2):
            tables, *rest = browser.execute_script(TABLES)
            own = (mdp.next_state, mdp.probability, mdp.reward, mdp.start)
            assert tables == [table.ravel().tolist() for table in own]
            assert rest == [gamma, limit, mdp.text().replace("\n", "")]
            browser = page(browser.execute_script("return playground.app.link"))  # which may be shorter

    def test_in_a_file(self, mdp: GridMdp, gamma: float, limit: int, page: Page, tmp_path: Path) -> None:
        browser, file = page(link(mdp, gamma, limit)), tmp_path / "map.txt"
        file.write_text(
            browser.execute_async_script(
                "URL.createObjectURL = blob => (blob.text().then(arguments[0]), '#');"
                "document.getElementById('download').click()"
            )
        )
        assert load(str(file)).text() == mdp.text()
        page("map=cliff").find_element("id", "load").send_keys(str(file))
        browser.execute_async_script("setTimeout(arguments[0], 100)")
        assert tiles(browser) == mdp.text().replace("\n", "")

    def test_in_a_command(self, mdp: GridMdp, gamma: float, limit: int, page: Page, tmp_path: Path) -> None:
        *before, line = page(link(mdp, gamma, limit)).find_element("id", "command").text.split(" && ")
        for each in before:
            subprocess.run(["sh", "-c", each], check=True, cwd=tmp_path)
        program, verb, *words = shlex.split(line)
        with called_from(tmp_path):
            config = configure(*words)
            compiled = config.env.compile()
        assert (program, verb, compiled.digest()) == ("gridworld", "train", mdp.digest())
        assert (config.evaluation.gamma, config.env.step_limit(compiled)) == (gamma, limit)
        assert gamma in (0.99, getattr(config.agent, "gamma", None))


HOSTILE = {  # a link, and a part of the sentence that the page says
    "map=<img src=x onerror=alert(1)>": "map: must be a shipped map's name, or rows of",
    "map=SG&slip=2": "slip: must be from 0 to 1",
    "map=SG&slip=1e": "slip: must be a number",
    "map=SG&gamma=0.9999999999999": "gamma: is too close to 1",
    "map=SG&step_reward=1e300": "step_reward: must be 0, or from 1e-30",
    "map=SG&max_episode_steps=1e9": "max_episode_steps: must be a whole number",
    "map=SG&__proto__=1": "the link has an unknown setting",
    "map=constructor": "map: must be a shipped map's name",
    "map=S_G.": "row 2 has 2 columns, row 1 has 1",
    f"map={'S' * 61}": "1 rows of 61 columns are too large",
    f"map={'S' * 100_000}": "the map is too large",
    "map=SWG": "no goal can be reached from the start in row 1, column 1",
    "map=S.G&gamma=1&step_reward=1": "gamma=1: an episode that never ends collects rewards",
    "map=SSCG": "a cliff 'C' leads back to the start, but there are 2",
}


def test_a_hostile_link_is_an_error_and_nothing_else(page: Page) -> None:
    browser = page(next(iter(HOSTILE)))
    found = browser.execute_async_script(
        "const [links, done] = arguments, said = [], message = document.getElementById('message');"
        "const next = () => {"
        "  said.push(message.hidden ? '' : message.textContent);"
        "  if (said.length === links.length) return done(said);"
        "  location.hash = links[said.length];"
        "};"
        "addEventListener('hashchange', next); next();",
        list(HOSTILE),
    )
    for said, sentence in zip(found, HOSTILE.values(), strict=True):
        assert sentence in said
    assert browser.execute_script("return document.images.length + document.scripts.length") == 2
    browser.find_element("id", "maps").send_keys("classic")
    assert message(browser) == ""
    assert browser.find_element("id", "optimum").text == "0.9321"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"\x00\xff\xfe<script>alert(1)</script>", "unknown tile"),
        (b"S." * 10_000, "the file is too large for a map"),
        (b"", "the map is empty"),
        (b"S..\n...", "there is no goal"),
    ],
)
def test_a_hostile_file_is_an_error(content: bytes, sentence: str, page: Page, tmp_path: Path) -> None:
    browser, file = page("map=cliff"), tmp_path / "<b>map.txt"
    file.write_bytes(content)
    before = tiles(browser)
    browser.find_element("id", "load").send_keys(str(file))
    browser.execute_async_script("setTimeout(arguments[0], 100)")
    assert message(browser).startswith("<b>map.txt: ")
    assert sentence in message(browser)
    assert tiles(browser) == before


def test_foreign_names_are_text(page: Page, tmp_path: Path) -> None:
    evil = "</script><script>document.title='x'</script><img src=x onerror=\"document.title='x'\">"
    mdp = dataclasses.replace(named_world("river_swim"), name=evil, state_names=(evil,) * 6)
    content = world_page(mdp, 0.99, 100)
    assert content.count("<script") == 2
    (tmp_path / "evil.html").write_text(content)
    browser = page(name=tmp_path / "evil.html")
    browser.find_element("css selector", "#states tbody tr").click()
    assert browser.title == "gridworld playground"
    assert browser.execute_script("return document.images.length") == 0
    assert evil[:60] in browser.find_element("id", "states").text


def test_it_is_drawn_on_with_keys_and_read_aloud(page: Page) -> None:
    browser = page("map=SG_..")
    cells = browser.find_elements("css selector", "[role=gridcell]")
    labels = [cell.get_attribute("aria-label") for cell in cells]
    assert labels[0] == "row 1, column 1: start, value 1.00, best right"
    assert labels[1] == "row 1, column 2: goal"
    browser.execute_script("document.querySelector('[role=gridcell]').focus()")
    keys = ActionChains(browser)
    keys.send_keys(Keys.ARROW_DOWN, "w").perform()
    assert tiles(browser) == "SG#."
    assert "wall" in browser.find_element("id", "cell").text
    keys.send_keys("z", Keys.ARROW_RIGHT, Keys.ARROW_RIGHT, "t").perform()
    assert tiles(browser) == "SG.T"
    assert browser.switch_to.active_element.get_attribute("aria-label") == "row 2, column 2: trap"
    browser.find_element("css selector", "#modes [aria-checked=true]").send_keys(Keys.ARROW_RIGHT)
    chosen = browser.find_element("css selector", "#modes [aria-checked=true]")
    assert (chosen.text, chosen == browser.switch_to.active_element) == ("Value iteration", True)
    keys.click(browser.find_element("css selector", "#tools [value='#']")).click(cells[0]).perform()
    assert tiles(browser) == "#G.T"
    assert "there is no start" in message(browser)
    shown = [browser.find_element("id", each).text for each in ("regret", "value", "optimum", "verdict")]
    assert shown == [*"\u2013" * 3, ""]  # not those of the world before
    browser.find_element("id", "undo").click()
    assert (tiles(browser), message(browser)) == ("SG.T", "")
    sizes = [browser.find_element("id", each) for each in ("rows", "cols")]
    for size, typed in zip(sizes, ("0", "3"), strict=True):  # a refused number is taken back
        size.send_keys(Keys.CONTROL + "a")
        size.send_keys(typed + Keys.ENTER)
    assert ([size.get_attribute("value") for size in sizes], tiles(browser)) == (["2", "3"], "SG..T.")


def test_a_cell_says_why_and_an_episode_goes_step_by_step(page: Page) -> None:
    browser = page("map=aima_4x3")
    browser.find_elements("css selector", "[role=gridcell]")[9].click()
    text = browser.find_element("id", "cell").text
    assert "right 0.53 0.53" in text
    assert "left ✓ 0.60 0.60" in text.replace(" ●", "")
    assert "right: 80 % to row 3, column 3 (reward -0.04, V* 0.57); 20 % stays" in text.replace("\u2212", "-")
    browser = page("map=S.W_T.G")
    told = []
    for button in ("forward", "forward", "forward", "forward", "forward", "back"):
        browser.find_element("id", button).click()
        told.append(browser.find_element("id", "episode").text)
    assert told[0] == "step 0 of 3: start; row 1, column 1"
    assert told[3] == told[4] == "step 3 of 3: right, reward 1.00, discounted return 0.98; row 2, column 3"
    assert told[5] == told[2] == "step 2 of 3: down, reward 0.00, discounted return 0.00; row 2, column 2"


def test_a_learner_goes_on_in_a_world_that_changes(page: Page) -> None:
    browser = page("map=S..G")
    browser.find_element("css selector", "[value=q_learning]").click()
    before = browser.execute_script(
        "const { process } = playground.app;"
        "for (let i = 0; i < 300; i++) process.step();"
        "return [process.steps, Array.from(process.q)]"
    )
    cell = browser.find_elements("css selector", "[role=gridcell]")[1]
    start = browser.find_element("css selector", "#tools [value=S]")
    ActionChains(browser).click(start).click(cell).perform()
    after = browser.execute_script(
        "const { process } = playground.app; return [process.steps, Array.from(process.q)]"
    )
    assert (tiles(browser), after) == ("SS.G", before)


MONKEY = """
const [seed, done] = arguments, keys = [..."w.sgtcz", "ArrowUp", "ArrowLeft", "Enter", "Home", "End"];
const values = ["0", "1", "0.5", "-1", "", "12", "1000"];
const kinds = "button, select, input:not([type=file]), summary, #states tr, #grid div";
let state = seed, left = 250;
const draw = of => of[(state = (state * 48271) % 2147483647) % of.length];
const act = () => {
  const all = [...document.querySelectorAll(kinds)];
  const one = draw(all.filter(each => !each.disabled && each.checkVisibility()));
  const press = new KeyboardEvent("keydown", { key: draw(keys), bubbles: true });
  if (one.role === "gridcell") one.focus(), one.dispatchEvent(press);
  else if (one.matches("select, input")) {
    one.value = one.matches("select") ? draw(one.options).value : draw(values);
    for (const kind of ["input", "change"]) one.dispatchEvent(new Event(kind));
  } else if (one.id !== "download") one.click();
  if (--left) (left % 5 ? queueMicrotask : requestAnimationFrame)(act);
  else done();
};
act();
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["world.html", "map.html", "table.html"])
def test_no_order_of_clicks_and_keys_is_an_error(name: str, page: Page) -> None:
    page(name=name).execute_async_script(MONKEY, 5)  # `page` looks at the browser's log


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("name", ["world.html", "map.html", "table.html"])
def test_a_phone_shows_it_whole(scheme: str, name: str, page: Page, browser: Any) -> None:
    screen = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    try:
        page("map=maze" if name == "world.html" else "", name)
        for mode in ("optimum", "sarsa"):
            browser.find_element("css selector", f"#modes [value={mode}]").click()
            wide, paper = browser.execute_script(
                "const style = getComputedStyle(document.body);"
                "return [document.documentElement.scrollWidth, style.backgroundColor]"
            )
            assert (wide, json.loads(f"[{paper[4:-1]}]")[0] > 128) == (390, scheme == "light")
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


LEARNED = """
const { app, rate, Learner, score } = playground, { world, solution, process, hyper } = app;
const steps = 10 * rate(), settings = { ...hyper, gamma: 0.99 };
return Array.from({ length: 20 }, (_, seed) => {
  let state = seed + 1;
  const random = () => (state = (state * 48271) % 2147483647) / 2147483647;
  const learner = new Learner(world, process.kind, settings, { world: random, agent: random });
  while (learner.steps < steps) learner.step();
  const policy = new Float64Array(learner.q.length), { A } = world;
  for (let at = 0; at < policy.length; at += A) {
    const row = Array.from(learner.q.subarray(at, at + A));
    policy[at + row.indexOf(Math.max(...row))] = 1;
  }
  return score(world, solution, policy).certified;
});
"""


@pytest.mark.parametrize("width", [390, 840])
def test_a_frame_shows_learning_at_once(width: int, page: Page, browser: Any, tmp_path: Path) -> None:
    """Numbers and curve are next to the board or right below it; in ten seconds every seed has learned."""
    shown = gridworld.playground("classic")._repr_html_()
    (tmp_path / "notebook.html").write_text(f'<!doctype html><body style="margin: 0">{shown}')
    screen = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    try:
        frame = page(name=tmp_path / "notebook.html").find_element("tag name", "iframe")
        browser.switch_to.frame(frame)
        assert browser.execute_script(LEARNED) == [True] * 20
        browser.execute_async_script(FITS)
        board, curve = (browser.find_element("id", each).rect for each in ("board", "curve"))
        wide = browser.execute_script("return document.body.scrollWidth")
        assert browser.find_element("css selector", "#modes [aria-checked=true]").text == "Q-learning"
        browser.switch_to.default_content()
        assert frame.size["width"] == wide
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert curve["y"] + curve["height"] - board["y"] < 700
    assert (curve["x"] > board["x"] + board["width"]) == (width == 840)


def test_python_takes_the_words_of_the_command_and_a_run(run: Path) -> None:
    page = gridworld.playground("cliff").html
    assert page == gridworld.playground("env=cliff").html != gridworld.playground({"env.slip": 0.1}).html
    assert gridworld.playground(gridworld.open_run(run)).html == gridworld.playground(run).html
    with pytest.raises(InputError, match="the run has no folder"):
        gridworld.playground(gridworld.train("agent=q_learning", total_timesteps=500, progress=False))


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("nowhere", "env=nowhere: no such choice; choose from aima_4x3"),
        ("clif --config-dir .", "did you mean cliff?"),
        ("nowhere.txt", "neither a shipped layout"),
        ("runs/", "runs: no such folder"),
        ("env=cliff maze", "maze: is not a setting; write env=maze"),
        ("env.slip=2", "slip=2.0: must be from 0 to 1"),
        ("cliff --out page", "--out page: must be the name of a file that ends with .html"),
        ("cliff --out ../page.html", "leads out of the current folder"),
        ("cliff --best", "--best: chooses between the models of a run"),
        ("env=deep_sea env.size=60", "is too large for the playground"),
        ("runs/mine/seed=0", "runs/mine/seed=0: no such run or map file"),
    ],
)
def test_a_mistake_on_the_command_line(line: str, sentence: str, refusal: Callable[[str], str]) -> None:
    assert sentence in refusal(f"playground.py {line}")


@pytest.fixture
def run(pages: Path, tmp_path: Path) -> Path:
    """Called as a run of a sweep may be, and as a setting is."""
    return Path(shutil.copytree(pages / "map", tmp_path / "env=cliff"))


def test_a_path_comes_before_a_setting(
    run: Path,
    refusal: Callable[[str], str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(run.parent)
    for words in (["env=cliff"], ["env=cliff/"], [str(run)]):
        command.main([*words, "--out", "page.html"])
        assert '"title":"q_learning on aima_4x3, seed 0' in Path("page.html").read_text()
    capsys.readouterr()
    assert "env=cliff: is a folder; give it alone" in refusal("playground.py env=cliff env.slip=0.1")
    assert "a run is given by --agent" in refusal("play.py env=cliff")
    assert "a run is given by --agent" in refusal("play.py env=cliff env.slip=0.1")


def test_what_is_damaged_is_named(run: Path, page: Page, capsys: pytest.CaptureFixture[str]) -> None:
    [checkpoint] = run.glob("checkpoints/*")
    content = checkpoint.read_bytes()
    (run / "visits.npy").unlink()
    checkpoint.write_bytes(content[: len(content) // 2])
    content = run_page(SavedRun(run))
    told = [f"{checkpoint}: not a state that can be read", f"{run}: has no visits.npy"]
    for line, sentence in zip(capsys.readouterr().err.splitlines(), told, strict=True):
        assert line.startswith(sentence)
        assert line.endswith("; the page is without it")
    (run / "page.html").write_text(content)
    verdict = page(name=run / "page.html").find_element("id", "verdict").text
    assert all(f"Missing: {sentence}" in verdict for sentence in told)


def test_the_browser_opens_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) is None)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    command.main(["env=cliff", "env.slip=0.25"])
    (file,) = tmp_path.glob("*/*")
    assert (opened, capsys.readouterr().out) == ([file.as_uri()], f"{file}\n")
    assert "&slip=0.25&" in file.read_text("utf-8")
    (tmp_path / "my map.txt").write_text("S.G\n")
    monkeypatch.chdir(tmp_path)
    command.main(["my map.txt", "--config-dir", ".", "--out", "page.html"])
    assert '"link":"map=S.G&' in Path("page.html").read_text("utf-8")

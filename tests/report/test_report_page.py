"""What a real browser shows of a report that is opened from disk: desktop and phone, light and dark."""

import json
from pathlib import Path

import pytest
from helpers.browser import check_transparent, chromium, look_at
from helpers.runs_folder import Maker, sweep
from helpers.support import SHORT, train_in

from gridworld.base.safe_read import sealed
from gridworld.commands import report as command

SIZES = ((390, 844), (1280, 900))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study with everything in it: pictures, online returns, split configurations, a run that failed."""
    runs = sweep(tmp_path_factory.mktemp("study") / "runs", 6)
    for seed in (0, 1):
        own = ["env=aima_4x3", "agent.ent_coef=0.05", "evaluation.every=2000"]  # by chance, one is certified
        own += ["tuned=none", "exploring_starts=1.0", "agent.gae_lambda=0.8", "agent.gamma=0.97"]
        own += ["agent.learning_rate=sqrt_0.01", "agent.policy_kwargs.optimizer_kwargs.eps=1e-6"]
        train_in(runs / f"real{seed}", *SHORT["ppo"], *own, f"seed={seed}")
    other = Maker("agent=ppo", "env=four_rooms")
    for seed in range(6):
        other.write(runs / f"faster{seed}", seed, 2000, agent__learning_rate=0.0123)
    manifest = runs / "ppo,classic,4" / "manifest.json"
    manifest.write_text(
        json.dumps(sealed(json.loads(manifest.read_text()) | {"status": "failed", "error": "boom"}))
    )
    with pytest.raises(SystemExit):
        command.main([str(runs), "--formats"])
    return runs / "report" / "report.html"


@pytest.mark.slow
def test_a_browser_shows_it(page: Path, tmp_path: Path) -> None:
    with chromium(tmp_path / "profile") as browser:
        for scheme in ("light", "dark"):
            for width, height in SIZES:
                shot = look_at(browser, page, scheme, width, height)
                wide, seen = browser.execute_script(
                    "const page = document.documentElement; return [page.scrollWidth, page.clientWidth]"
                )
                assert wide == seen <= width  # nothing makes the page scroll sideways
                corner = shot.convert("L").getpixel((2, 2))
                assert (corner > 240) if scheme == "light" else (corner < 40)  # type: ignore[operator]
                check_transparent(browser, shot, ".chart, .pictures [src*='image/png']")
        headings = browser.execute_script(
            "return [...document.querySelectorAll('h1, h2')].map(h => h.innerText)"
        )
        assert headings == [
            "Which agent solves which task",
            *("aima_4x3", "classic", "cliff", "four_rooms", "All tasks", "Not certified", "Runs", "Methods"),
        ]
        text = browser.execute_script("return document.body.innerText")
        for words in (
            *("a2c", "dqn", "q_learning", "sarsa", "ppo (learning_rate=0.0123)"),
            *(
                "On classic, dqn is certified optimal on all 6 seeds",
                "1 run is not in the statistics",
                "boom",
            ),
        ):
            assert words in text, words
        images = browser.execute_script("return [...document.images].map(i => [i.complete, i.naturalWidth])")
        # Of the one run with pictures policy, error, visits, learning; on two of four tasks online returns.
        assert len(images) == 4 + (4 * 4 + 2 * 3 + 3)
        assert all(complete and width > 100 for complete, width in images)
        large = browser.execute_script(
            "document.querySelector('.pictures input').click();"
            "return document.querySelector('.pictures img').getBoundingClientRect().width / innerWidth"
        )
        assert large == 1  # a click shows a picture as large as the window
        assert browser.get_log("browser") == []

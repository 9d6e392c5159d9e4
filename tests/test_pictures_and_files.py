"""Recordings keep every pixel, pictures of a policy show what they say, and files are written whole."""

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gridworld import record
from gridworld.errors import InputError
from gridworld.files import replacing, write_json
from gridworld.layout import load, parse
from gridworld.mdp import compile_mdp
from gridworld.policy_map import DISAGREES, draw_policy_map, viridis
from gridworld.render import WALL
from gridworld.solve import value_iteration

CLASSIC = compile_mdp(load("classic"))
WALK = np.array([0, 1, 1, 2, 3, 4, 5, 11, 17, 16])


def frames_of(image: Image.Image) -> list[tuple[np.ndarray, float]]:
    shown = []
    for index in range(image.n_frames):
        image.seek(index)
        shown.append((np.array(image.convert("RGB")), float(image.info["duration"])))
    return shown


@pytest.mark.parametrize("encode", [record.encode_gif, record.encode_apng])
@pytest.mark.parametrize("fps", [1, 4, 25])
def test_animations_are_exact_and_last_as_long_as_they_should(encode, fps: int) -> None:
    frames = record.draw_states(CLASSIC, WALK, cell_size=20)
    shown = frames_of(Image.open(io.BytesIO(encode(frames, fps))))
    distinct = [frame for frame, before in zip(frames, [None, *frames], strict=False) if frame is not before]
    assert len(shown) == len(distinct)  # a repeated frame is shown for longer
    assert all(np.array_equal(got, frame) for (got, _), frame in zip(shown, distinct, strict=True))
    held = len(frames) + 4  # the last frame rests
    assert sum(duration for _, duration in shown) == pytest.approx(1000 * held / fps, abs=1)


def test_pngs_are_numbered_exact_and_replace_what_was_there(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    record.save_pngs(record.draw_states(CLASSIC, WALK, 20), folder)
    record.save_pngs(record.draw_states(CLASSIC, WALK[:3], 20), folder)
    assert sorted(path.name for path in folder.iterdir()) == ["0000.png", "0001.png", "0002.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
    for path, frame in zip(sorted(folder.iterdir()), record.draw_states(CLASSIC, WALK[:3], 20), strict=True):
        assert np.array_equal(np.array(Image.open(path).convert("RGB")), frame)


def test_more_than_256_colours_survive() -> None:
    noise = np.random.default_rng(0).integers(256, size=(40, 40, 3), dtype=np.uint8)
    shown = frames_of(Image.open(io.BytesIO(record.encode_apng([noise, noise[::-1].copy()], 10))))
    assert np.array_equal(shown[0][0], noise)


def test_mp4_has_even_sides_and_every_frame(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="PyAV is not installed (extra `video`)")
    layout = parse("S.\n.G\n.T", "odd")
    frames = record.draw_states(compile_mdp(layout), np.array([0, 1, 3]), cell_size=13)
    assert frames[0].shape == (65, 52, 3)
    record.save_animation(frames, tmp_path / "episode.mp4", 5)
    with av.open(str(tmp_path / "episode.mp4")) as video:
        stream = video.streams.video[0]
        assert (stream.width, stream.height) == (52, 66)
        assert stream.average_rate == 5
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(stream)]
    assert len(pictures) == 3 + 4
    assert np.abs(pictures[0][:65].astype(int) - frames[0]).mean() < 3


def test_large_maps_get_smaller_cells() -> None:
    assert record.automatic_cell_size(CLASSIC) == 100
    wide = compile_mdp(parse("S" + "." * 98 + "G", "wide"))
    assert record.automatic_cell_size(wide) == 9


@pytest.mark.parametrize("name", ["classic", "four_rooms", "maze", "aima_4x3"])
def test_policy_map_colours_cells_by_value_and_frames_mistakes(name: str) -> None:
    mdp = compile_mdp(load(name))
    best = value_iteration(mdp, 0.99)
    greedy = np.argmax(best.optimal, axis=1)
    cell = min(64, 640 // (max(mdp.layout.num_rows, mdp.layout.num_cols) + 2))
    wrong = int(mdp.start_states[0])
    frame = draw_policy_map(mdp, best.v, greedy, best.optimal, "all right")
    assert not (frame == DISAGREES).all(axis=2).any()

    greedy[wrong] = int(np.argmin(best.optimal[wrong]))
    frame = draw_policy_map(mdp, best.v, greedy, best.optimal, "one wrong")
    shown = ~(mdp.terminal | mdp.wall)
    low, high = best.v[shown].min(), best.v[shown].max()
    for state, (row, col) in enumerate(mdp.layout.cells()):
        y, x = (row + 1) * cell, (col + 1) * cell
        corner = tuple(frame[y + cell // 6, x + cell // 6])
        if mdp.wall[state]:
            assert corner == WALL
        elif shown[state]:
            assert corner == viridis((best.v[state] - low) / (high - low))
        framed = (frame[y : y + cell, x : x + cell] == DISAGREES).all(axis=2).any()
        assert framed == (state == wrong)


def test_policy_map_of_one_value_and_of_a_large_world() -> None:
    flat = np.zeros(30)
    draw_policy_map(CLASSIC, flat, np.zeros(30, dtype=int), np.ones((30, 4), dtype=bool))
    large = compile_mdp(parse("S" + "." * 198 + "G\n" + ("." * 200 + "\n") * 199, "large"))
    states = large.num_states
    everything = np.ones((states, 4), dtype=bool)
    frame = draw_policy_map(large, np.arange(states) / states, np.zeros(states, dtype=int), everything)
    assert frame.shape == (808, 808, 3)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "content.json"
    write_json(path, {"good": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, {"bad": float("nan")})
    with contextlib.suppress(RuntimeError), replacing(path) as part:
        part.write_text("half")
        raise RuntimeError
    assert path.read_text() == '{\n  "good": 1\n}\n'
    assert [entry.name for entry in tmp_path.iterdir()] == ["content.json"]


def test_a_missing_video_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'gridworld\[video\]'"):
        record.require_video()

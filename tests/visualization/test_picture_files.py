"""Recordings keep every pixel, and files are written whole."""

import errno
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gridworld.base.atomic_write import replacing, replacing_folder, write_json
from gridworld.base.errors import InputError, failure
from gridworld.envs.rendering import draw_frame, pack
from gridworld.visualization import files
from gridworld.visualization.animation import animation_of_frames, animation_of_states
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse

CLASSIC = compile_mdp(load("classic"))
FRAME = draw_frame(CLASSIC, 0, 20)
WALK = np.array([0, 1, 1, 2, 3, 4, 5, 11, 17, 16])


def frames_of(content: bytes) -> list[tuple[np.ndarray, float]]:
    image, shown = Image.open(io.BytesIO(content)), []
    for index in range(image.n_frames):
        image.seek(index)
        shown.append((np.array(image.convert("RGB")), float(image.info["duration"])))
    return shown


@pytest.mark.parametrize("encode", [files.encode_gif, files.encode_apng])
@pytest.mark.parametrize("fps", [1, 25])
def test_animations_are_exact_and_last_as_long_as_they_should(encode, fps: int) -> None:
    shown = frames_of(encode(animation_of_states(CLASSIC, WALK, cell_size=20), fps))
    distinct = [state for state, before in zip(WALK, [None, *WALK], strict=False) if state != before]
    assert len(shown) == len(distinct)  # a repeated frame is shown for longer
    for (got, _), state in zip(shown, distinct, strict=True):
        assert np.array_equal(got, draw_frame(CLASSIC, int(state), 20))
    held = len(WALK) + 4  # the last frame rests
    assert sum(duration for _, duration in shown) == pytest.approx(1000 * held / fps, abs=1)


def test_a_gif_holds_any_film_exactly() -> None:
    """Frames that differ anywhere, nowhere, or everywhere, and last longer than one picture of a GIF can."""
    chance = np.random.default_rng(0)
    palette = chance.integers(256, size=(200, 3), dtype=np.uint8)
    frames = [palette[chance.integers(200, size=(23, 31))]]
    for _ in range(12):
        frame = frames[-1].copy()
        top, left = chance.integers(23), chance.integers(31)
        box = slice(top, top + chance.integers(5)), slice(left, left + chance.integers(9))
        frame[box] = palette[chance.integers(200)]
        frames.append(frame)
    gif = files.encode_gif(animation_of_frames(frames, [frames[0][0, 0], (0, 0, 0)]), 20)
    assert files.encode_gif(animation_of_frames(map(pack, frames), [frames[0][0, 0], (0, 0, 0)]), 20) == gif
    shown = frames_of(gif)
    assert len(shown) == len(frames)
    assert all(np.array_equal(got, frame) for (got, _), frame in zip(shown, frames, strict=True))
    assert sum(duration for _, duration in shown) == (len(frames) + 4) * 50
    still = animation_of_states(CLASSIC, np.zeros(1500, dtype=int), cell_size=4)
    assert sum(duration for _, duration in frames_of(files.encode_gif(still, 1))) == 1504 * 1000
    noise = chance.integers(256, size=(300, 300, 3), dtype=np.uint8)
    with pytest.raises(InputError, match="at most 65,535 colours"):
        animation_of_frames([noise])


def test_of_too_many_colours_the_frequent_stay_and_others_become_the_nearest() -> None:
    frames = [np.full((60, 40, 3), grey, dtype=np.uint8) for grey in range(0, 256, 2)]
    for grey, frame in zip(range(0, 256, 2), frames, strict=True):
        frame[0, :2] = (grey, grey, grey + 1), (grey, grey + 1, grey)
    shown = animation_of_frames(frames)
    for key, frame in zip(shown.keys, frames, strict=True):
        picture = np.asarray(shown.draw(key).convert("RGB")).astype(int)
        assert np.array_equal(picture[1:], frame[1:])
        assert np.abs(picture - frame).max() <= 1


def test_png_is_exact() -> None:
    noise = np.random.default_rng(0).integers(256, size=(13, 17, 3), dtype=np.uint8)
    transparent = np.random.default_rng(1).integers(256, size=(13, 17, 4), dtype=np.uint8)
    half = np.concatenate([np.zeros_like(noise), noise, np.tile(noise[-1:], (9, 1, 1))])
    for frame in (noise, FRAME, half, noise[:1, :1], transparent):
        image = Image.open(io.BytesIO(files.encode_png(frame)))
        image.load()  # checks the sums
        assert image.mode == "RGBA"[: frame.shape[2]]
        assert np.array_equal(np.array(image), frame)


def test_pngs_are_numbered_exact_and_replace_what_was_there(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    files.save_pngs(animation_of_states(CLASSIC, WALK, 20), folder)
    files.save_pngs(animation_of_states(CLASSIC, WALK[:3], 20), folder)
    assert sorted(path.name for path in folder.iterdir()) == ["0000.png", "0001.png", "0002.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
    for path, state in zip(sorted(folder.iterdir()), WALK[:3], strict=True):
        assert np.array_equal(np.array(Image.open(path).convert("RGB")), draw_frame(CLASSIC, int(state), 20))


def test_films_that_memory_or_a_player_could_not_hold_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    large = animation_of_states(CLASSIC, WALK, 500)
    files.check_size(large, ["png", "gif", "apng"])
    with pytest.raises(InputError, match="mp4: 4000 x 3500 pixels are too many for a video"):
        files.check_size(large, ["mp4"])
    long = animation_of_states(CLASSIC, np.tile(WALK, 5), 500)
    with pytest.raises(InputError, match="apng: 50 pictures of 4000 x 3500 pixels are too many"):
        files.check_size(long, ["apng"])
    assert animation_of_states(CLASSIC, WALK).size == (800, 700)
    assert animation_of_states(compile_mdp(parse("S" + "." * 98 + "G", "wide")), WALK[:1]).size == (918, 27)
    monkeypatch.setattr(files, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install -e '.*\[video\]'"):
        files.require_video()


def test_mp4_has_even_sides_and_every_frame(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="PyAV is not installed (extra `video`)")
    mdp = compile_mdp(parse("S.\n.G\n.T", "odd"))
    files.save(animation_of_states(mdp, np.array([0, 1, 3]), cell_size=13), tmp_path / "episode.mp4", 5)
    with av.open(str(tmp_path / "episode.mp4")) as video:
        stream = video.streams.video[0]
        assert (stream.width, stream.height) == (52, 66)
        assert stream.average_rate == 5
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(stream)]
    assert len(pictures) == 3 + 4
    assert draw_frame(mdp, 0, 13).shape == (65, 52, 3)
    assert np.abs(pictures[0][:65].astype(int) - draw_frame(mdp, 0, 13)).mean() < 3


# ---- what is written, is written whole -----------------------------------------------------------------


@pytest.mark.parametrize("keep", [True, False], ids=["an older one", "none"])
def test_a_failed_write_leaves_the_old_file_or_folder(keep: bool, tmp_path: Path) -> None:
    folder, file = tmp_path / "frames", tmp_path / "content.json"
    if keep:
        folder.mkdir()
        (folder / "old").touch()
        write_json(file, {"good": 1})
    before = sorted(tmp_path.rglob("*"))

    def fill(replace: Any, path: Path) -> None:
        with replace(path) as part:
            new = part / "new" if path == folder else part
            new.write_text("half")
            raise OSError(errno.ENOSPC, "no space", str(new))

    for replace, path, new in ((replacing_folder, folder, folder / "new"), (replacing, file, file)):
        with pytest.raises(OSError, match="no space") as error:
            fill(replace, path)
        assert error.value.filename == str(new)
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(file, {"bad": float("nan")})
    assert sorted(tmp_path.rglob("*")) == before
    assert not keep or file.read_text() == '{\n  "good": 1\n}\n'


FAILURES = [
    (errno.EACCES, "a/b.gif", "a/b.gif: Permission denied; choose another folder, or make a writable"),
    (errno.EROFS, "b.gif", "b.gif: Read-only file system; choose another folder, or make . writable"),
    (errno.ENOSPC, "a/b.gif", "a/b.gif: No space left on device; free some space there"),
    (errno.EISDIR, "a/b.gif", "a/b.gif: Is a directory"),
    (errno.EIO, None, "Input/output error"),
    (None, None, "cannot write mode P as PNG"),
]


@pytest.mark.parametrize(("code", "where", "sentence"), FAILURES)
def test_a_failed_write_says_what_would_be_right(code: int | None, where: str | None, sentence: str) -> None:
    error = OSError("cannot write mode P as PNG") if code is None else OSError(code, os.strerror(code), where)
    assert failure(error).startswith(sentence)

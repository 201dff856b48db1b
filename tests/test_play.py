"""People at the keyboard, and films of what they did: Gymnasium's own `play` and `RecordVideo`."""

import cv2
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from test_misuse import OPTIONS

import parkenv  # noqa: F401  registers the environments

pygame = pytest.importorskip("pygame")


def played(env, keys, noop, monkeypatch):
    """The actions of a game in which these keys are held, one list a frame."""
    from gymnasium.utils.play import play

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    frames, held, actions = iter(keys), set(), []

    def events():
        wanted = set(next(frames, []))
        told = [pygame.event.Event(pygame.KEYDOWN, key=key) for key in wanted - held]
        told += [pygame.event.Event(pygame.KEYUP, key=key) for key in held - wanted]
        held.clear()
        held.update(wanted)
        return [*told, *([] if wanted else [pygame.event.Event(pygame.QUIT)])]

    monkeypatch.setattr(pygame.event, "get", events)
    play(env, fps=1000, seed=3, noop=noop, callback=lambda _obs, _next, action, *_: actions.append(action))
    return actions


def test_search_is_played_with_five_keys(monkeypatch):
    env = gym.make("parkenv/Search-v2", scenario="campus", render_mode="rgb_array")
    keys = [[pygame.K_w], [pygame.K_s], [pygame.K_a], [pygame.K_d], [pygame.K_SPACE]]
    assert played(env, keys, 4, monkeypatch) == [0, 1, 2, 3, 4]


def test_drive_is_played_with_four_keys_and_two_at_once(monkeypatch):
    env = gym.make("parkenv/Drive-v1", render_mode="rgb_array")
    keys = [[pygame.K_w], [pygame.K_w, pygame.K_a], [pygame.K_d, pygame.K_s]]
    actions = played(env, keys, np.zeros(2, dtype=np.float32), monkeypatch)
    assert np.array_equal(actions, [[1, 0], [1, 1], [-1, -1]])


@pytest.mark.parametrize("name", OPTIONS)
def test_every_environment_is_filmed(name, tmp_path):
    pytest.importorskip("moviepy")
    env = gym.make(name, render_mode="rgb_array", **OPTIONS[name])
    env = RecordVideo(env, str(tmp_path / "films"))
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(3):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            break
    env.close()
    (film,) = (tmp_path / "films").glob("*.mp4")
    frames = cv2.VideoCapture(str(film))
    there, frame = frames.read()
    assert there
    assert frame.std() > 5.0

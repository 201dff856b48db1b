"""A window on the screen for `render_mode="human"`."""

from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from parkenv.errors import needs_extra


class Window:
    def __init__(self, title: str) -> None:
        self._title = title
        self._screen: Any = None
        self._ticker: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Window, (self._title,)  # a copy is not open

    def show(self, frame: NDArray[np.uint8], fps: float) -> None:
        """Show a frame, (h, w, 3), at most `fps` frames per second.

        Raises:
            gymnasium.error.DependencyNotInstalled: pygame is not installed.
        """
        try:
            import pygame
        except ImportError as error:
            raise DependencyNotInstalled(needs_extra('render_mode "human"', "human")) from error
        if self._screen is None:
            pygame.display.init()
            self._screen = pygame.display.set_mode(frame.shape[1::-1])
            self._ticker = pygame.time.Clock()
            pygame.display.set_caption(self._title)
        self._screen.blit(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), (0, 0))
        # If events are not handled, the desktop reports the window as not responding.
        pygame.event.pump()
        pygame.display.flip()
        self._ticker.tick(fps)

    def close(self) -> None:
        if self._screen is not None:
            import pygame

            pygame.display.quit()
            self._screen = None

"""A window that shows frames, for people who watch an environment (``render_mode="human"``)."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from cudc_bench.errors import RunError, UsageError

if TYPE_CHECKING:
    from cudc_bench.envs.drawing import Frame


class Window:
    """A window; it opens with the first frame and takes that frame's size.

    Args:
        title: what it is called.
        fps: frames a second, at most: :meth:`show` waits for the time of its frame.

    Raises:
        UsageError: pygame, which makes windows, is not installed.
    """

    def __init__(self, title: str, fps: int) -> None:
        if find_spec("pygame") is None:
            raise UsageError("the render mode 'human' shows a window, for which pygame is missing: pip install pygame; or use 'rgb_array'.")
        self._title, self._fps = title, fps
        self._surface: Any = None

    def show(self, frame: Frame) -> None:
        """Show a frame (height, width, 3).

        Raises:
            RunError: no window can be opened here.
        """
        import pygame

        if self._surface is None:
            try:
                pygame.display.init()
                self._surface = pygame.display.set_mode(frame.shape[1::-1])
            except pygame.error as error:
                raise RunError(f"a window cannot be opened here ({error}); use the render mode 'rgb_array'.") from None
            pygame.display.set_caption(self._title)
            self._clock = pygame.time.Clock()
        self._surface.blit(pygame.surfarray.make_surface(frame.swapaxes(0, 1)), (0, 0))
        # Without this, the system takes the window for one that hangs.
        pygame.event.pump()
        self._clock.tick(self._fps)
        pygame.display.flip()

    def close(self) -> None:
        """Close it; another frame opens it again."""
        if self._surface is not None:
            import pygame

            pygame.display.quit()
            self._surface = None

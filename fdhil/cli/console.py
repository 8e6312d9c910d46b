"""The terminal, as rich writes to it: no text from outside can steer it."""

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from fdhil.cli.terminal_text import without_controls


class PrintableConsole(Console):
    """A console that shows control characters of a text as a mark, one column wide.

    Names of machines, programs, files and devices come from outside. Colours and the cursor are rich's own business: it
    writes their sequences later than this, or marks them as control segments.
    """

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a renderable."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else without_controls(text), style, control)

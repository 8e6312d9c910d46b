"""A rich console on which foreign text cannot control the terminal."""

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from fdhil.cli.terminal_text import replace_controls


class PrintableConsole(Console):
    """A console that replaces control characters of texts, such as names of machines, programs, files and devices.

    Colours and cursor movement are unaffected: rich writes their sequences later or as control segments.
    """

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a renderable."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else replace_controls(text), style, control)

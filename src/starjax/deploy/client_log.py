"""Lines of a server about its clients: arrivals, reasons of refusals, counts at the end."""

from collections.abc import Callable

from starjax.core import errors

_MAX_LINES = 5  # refusals of one client in the log; the others are counted
_MAX_TEXT = 200  # characters


class ClientLog:
    """Log of one client.

    Attributes:
      answered, refused: requests so far.
    """

    def __init__(self, write: Callable[[str], None], name: str) -> None:
        self._write, self._name = write, name
        self._seen: set[str] = set()
        self.answered = self.refused = 0
        self._line("connected")

    def refuse(self, error: str) -> None:
        """Counts a refused request; each reason is written once."""
        self.refused += 1
        text = error[:_MAX_TEXT]
        if text not in self._seen and len(self._seen) < _MAX_LINES:
            self._seen.add(text)
            self._line(f"refused: {text}")

    def leave(self, reason: str) -> None:
        """Writes the counts."""
        ending = f": {reason[:_MAX_TEXT]}" if reason else ""
        self._line(f"left; {self.answered} answered, {self.refused} refused{ending}")

    def _line(self, text: str) -> None:
        self._write(errors.printable(f"{self._name} {text}").replace("\n", " "))
